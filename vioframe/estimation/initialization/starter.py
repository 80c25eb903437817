"""How an estimate begins, and begins anew where the last one was lost: the same for every back-end."""

from __future__ import annotations

from vioframe.estimation.initialization.hand_eye import CameraRotation
from vioframe.estimation.initialization.initializer import Initializer
from vioframe.estimation.recovery import continued_from
from vioframe.stopwatch import Stopwatch
from vioframe.types import Calibration, Estimate, FrameTracks, ImuSegment, NavState, Status


class Starter:
    """Feeds the initialiser, and puts each new start where the body was last."""

    def __init__(
        self, calibration: Calibration, *, imu_noise_factor: float = 4.0, unknown_camera_rotation: bool = False
    ) -> None:
        self._initializer = Initializer(
            calibration, imu_noise_factor=imu_noise_factor, unknown_camera_rotation=unknown_camera_rotation
        )
        self._last: NavState | None = None

    @property
    def calibration(self) -> Calibration:
        """That of the sensors, with the camera's rotation that was found in place of an unknown one."""
        return self._initializer.calibration

    @property
    def camera_rotation(self) -> CameraRotation | None:
        """What the hand-eye calibration found; None where it was not asked for."""
        return self._initializer.camera_rotation

    def begin(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        """Take one frame; an estimate with the state to begin with, or that of a back-end still initialising."""
        watch = Stopwatch()
        initial = self._initializer.add(imu, tracks)
        watch.lap("initialise")
        if initial is None:
            refusal = self._initializer.refusal
            refused = (f"initialisation refused: {refusal}",) if refusal else ()
            return Estimate(Status.INITIALISING, events=refused, stage_seconds=watch.seconds)
        nav, events = initial.states[-1], [f"initialised ({initial.method})"]
        if self.camera_rotation is not None:
            events.append(str(self.camera_rotation))
        if self._last is not None:
            nav = continued_from(self._last, nav)
        self._last = nav
        return Estimate(Status.TRACKING, nav, events=tuple(events), stage_seconds=watch.seconds)

    def follow(self, state: NavState) -> None:
        """Remember where the body is, for a new start."""
        self._last = state

    def lose(self, why: str) -> Estimate:
        """Forget what led here, for a new start."""
        self._initializer.reset()
        return Estimate(Status.LOST, events=(f"lost: {why}",))
