"""Finds where an estimator may begin, one frame at a time."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from vioframe.estimation.initialization import dynamic, static
from vioframe.estimation.initialization.hand_eye import CameraRotation, RotationCalibrator
from vioframe.estimation.initialization.window import LARGEST_IMU_GAP_S, InitialEstimate, Packet, RefusalError
from vioframe.types import Calibration, FrameTracks, ImuSegment

_log = logging.getLogger("vioframe.estimation.initialization")

# Length of the standstill that the static method needs.
_STATIC_WINDOW_S = 1.0
# The dynamic method is first tried when the window is this long, and looks back no farther than this; every so often.
_SHORTEST_WINDOW_S, _LONGEST_WINDOW_S, _ATTEMPT_INTERVAL_S = 1.5, 3.0, 0.1
# Times ``imu_noise_factor`` in the dynamic method, which has no later readings to correct what vibration, scale and
# alignment errors do over its seconds: with 8 in all its squared errors on EuRoC's flights are as its covariance says.
_IN_MOTION = 2.0


class Initializer:
    """Tries the static method at every frame, and the dynamic one every so often, until one is sure of itself.

    Where the camera's rotation on the body is not known both wait for its hand-eye calibration, which is done once.
    ``imu_noise_factor`` is that of :meth:`~vioframe.types.ImuNoise.in_flight`. Every attempt is logged to
    ``vioframe.estimation.initialization``.
    """

    def __init__(self, calibration: Calibration, imu_noise_factor: float = 4.0) -> None:
        self._calibration = calibration
        self._in_flight = replace(calibration, imu=calibration.imu.in_flight(_IN_MOTION * imu_noise_factor))
        self._calibrator = None if calibration.cameras[0].rotation_known else RotationCalibrator(calibration)
        self._camera_rotation: CameraRotation | None = None
        self._refusals: dict[str, str] = {}
        self._packets: list[Packet] = []
        self._last_attempt_ns: int | None = None

    @property
    def calibration(self) -> Calibration:
        """That of the sensors, with the camera's rotation that was found in place of the unknown one."""
        return self._calibration

    @property
    def camera_rotation(self) -> CameraRotation | None:
        """What the hand-eye calibration found; None where it has not, or was not asked for."""
        return self._camera_rotation

    @property
    def refusal(self) -> str:
        """Why the last attempt of each method came to nothing, in one line; "" before the first and after a success."""
        return "; ".join(f"{method}: {reason}" for method, reason in self._refusals.items())

    def reset(self) -> None:
        """Forget everything seen, but not how the camera is turned on the body."""
        if self._calibrator is not None:
            self._calibrator.reset()
        self._packets.clear()
        self._last_attempt_ns = None
        self._refusals.clear()

    def add(self, imu: ImuSegment, tracks: FrameTracks) -> InitialEstimate | None:
        """Take one frame; an estimate whose newest state is at this frame, or None as long as none can be trusted."""
        if imu.largest_gap_s > LARGEST_IMU_GAP_S:
            self.reset()
            _log.info("no readings for %.2f s: begun anew", imu.largest_gap_s)
        self._packets.append((imu, tracks.finite()))
        self._packets = self._last(_LONGEST_WINDOW_S)
        if self._calibrator is not None and not self._find_camera_rotation(self._calibrator, imu, tracks):
            return None
        for method, attempt in (("static", self._static), ("dynamic", self._dynamic)):
            try:
                estimate = attempt()
            except (RefusalError, np.linalg.LinAlgError) as refusal:
                self._refusals[method] = str(refusal)
                _log.debug("%d %s refused: %s", tracks.t_ns, method, refusal)
                continue
            if estimate is not None:
                _log.info("%d %s initialisation accepted", tracks.t_ns, method)
                self._refusals.clear()
                return estimate
        return None

    def _find_camera_rotation(self, calibrator: RotationCalibrator, imu: ImuSegment, tracks: FrameTracks) -> bool:
        found = calibrator.add(imu, tracks)
        if found is None:
            if calibrator.refusal:
                self._refusals["hand-eye"] = calibrator.refusal
            return False
        self._refusals.clear()
        self._calibrator, self._camera_rotation = None, found
        self._calibration = self._calibration.with_camera(0, R_BC=found.R_BC, rotation_known=True)
        self._in_flight = self._in_flight.with_camera(0, R_BC=found.R_BC, rotation_known=True)
        return True

    def _static(self) -> InitialEstimate | None:
        packets = self._last(_STATIC_WINDOW_S)
        if _duration_s(packets) < 0.95 * _STATIC_WINDOW_S:
            return None
        return static.initialise(packets, self._calibration.imu)

    def _dynamic(self) -> InitialEstimate | None:
        newest_ns = self._packets[-1][1].t_ns
        last_ns = self._last_attempt_ns
        if last_ns is not None and newest_ns - last_ns < _ATTEMPT_INTERVAL_S * 1e9:
            return None
        if _duration_s(self._packets) < _SHORTEST_WINDOW_S:
            return None
        self._last_attempt_ns = newest_ns
        return dynamic.initialise(self._packets, self._in_flight)

    def _last(self, seconds: float) -> list[Packet]:
        """The frames of the last ``seconds``."""
        oldest_ns = self._packets[-1][1].t_ns - seconds * 1e9
        return [packet for packet in self._packets if packet[1].t_ns >= oldest_ns]


def _duration_s(packets: list[Packet]) -> float:
    return (packets[-1][1].t_ns - packets[0][1].t_ns) * 1e-9
