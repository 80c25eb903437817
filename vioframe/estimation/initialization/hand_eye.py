"""How the camera is turned on the body, from tracks and gyroscope alone: hand-eye calibration of the rotation.

    chain keyframes -> turned about two axes? -> closed form -> refine on all tracks -> judge

Translation plays no part, so that neither scale, gravity nor the lever arm need be known. Derivation:
``docs/derivations/initialization.md``.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass

import numpy as np

from vioframe.estimation.inertial.preintegration import Preintegrated, join_segments, preintegrate
from vioframe.estimation.initialization.estimate import RefusalError
from vioframe.estimation.initialization.hand_eye_solver import Chain, Solution, second_turn, solve
from vioframe.estimation.initialization.options import InitializationOptions
from vioframe.estimation.initialization.window import finite_tracks
from vioframe.geometry import so3
from vioframe.types import Calibration, Float, FrameTracks, ImuSegment

_log = logging.getLogger("vioframe.estimation.initialization")

_KEYFRAME_NS, _ATTEMPT_EVERY = 180_000_000, 3
_FEWEST_KEYFRAMES, _MOST_KEYFRAMES = 10, 60
# What noise in the tracks (which pulls where parallax is small) and the gyroscope's own axes cost beyond the scatter:
# simulated and real recordings show 0.05 to 0.5 degrees.
_SYSTEMATIC_DEG = 0.3
_MAX_MISFIT, _LEAST_MISFIT = 2.0, 0.1


@dataclass(frozen=True, slots=True)
class CameraRotation:
    """``R_BC`` (3, 3), and the covariance ``cov`` (3, 3) rad^2 of its right perturbation."""

    R_BC: Float
    cov: Float

    @property
    def sigma_deg(self) -> float:
        """Standard deviation about the axis that is known worst."""
        return float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(self.cov)[-1])))

    def __str__(self) -> str:
        quat = " ".join(f"{q:.5f}" for q in so3.to_quat_xyzw(self.R_BC))
        return f"camera's rotation on the body found to {self.sigma_deg:.2f} deg: R_BC as quat_xyzw {quat}"


class RotationCalibrator:
    """Finds R_BC from the first frames of a recording; what ``calibration`` says of it is not used.

    The body must turn about two axes. Every attempt is logged to ``vioframe.estimation.initialization``.
    """

    def __init__(self, calibration: Calibration, options: InitializationOptions | None = None) -> None:
        self._calibration = calibration
        self._options = options or InitializationOptions()
        self._tracks: deque[FrameTracks] = deque(maxlen=_MOST_KEYFRAMES)
        self._imu: deque[Preintegrated] = deque(maxlen=_MOST_KEYFRAMES - 1)
        self._since_keyframe: list[ImuSegment] = []
        self._since_attempt = 0
        self.refusal = ""
        """Why the last attempt came to nothing, in one line; "" before the first and after a success."""

    def reset(self) -> None:
        """Forget everything seen."""
        self._tracks.clear()
        self._imu.clear()
        self._since_keyframe.clear()
        self._since_attempt = 0
        self.refusal = ""

    def add(self, imu: ImuSegment, tracks: FrameTracks) -> CameraRotation | None:
        """Take one frame and the readings since the one before; the rotation once it can be trusted, else None."""
        if imu.largest_gap_s > self._options.largest_imu_gap_s:
            self.reset()
        if not self._chain(imu, tracks) or len(self._tracks) < _FEWEST_KEYFRAMES:
            return None
        self._since_attempt += 1
        if self._since_attempt < _ATTEMPT_EVERY:
            return None
        self._since_attempt = 0
        try:
            found = self._attempt()
        except (RefusalError, np.linalg.LinAlgError) as refusal:
            self.refusal = str(refusal)
            _log.debug("%d hand-eye refused: %s", tracks.t_ns, refusal)
            return None
        self.refusal = ""
        _log.info("%d %s", tracks.t_ns, found)
        return found

    def _chain(self, imu: ImuSegment, tracks: FrameTracks) -> bool:
        """Whether the frame became a keyframe."""
        if not self._tracks:
            self._tracks.append(finite_tracks(tracks))
            return True
        self._since_keyframe.append(imu)
        if tracks.t_ns - self._tracks[-1].t_ns < _KEYFRAME_NS:
            return False
        zero = np.zeros(3)
        self._imu.append(preintegrate(join_segments(self._since_keyframe), zero, zero, self._calibration.imu))
        self._tracks.append(finite_tracks(tracks))
        self._since_keyframe.clear()
        return True

    def _attempt(self) -> CameraRotation:
        options, chain = self._options, Chain(tuple(self._tracks), tuple(self._imu))
        turned = second_turn(chain)
        if not turned >= options.min_second_turn_rad:
            raise RefusalError(
                f"turned by {turned:.2f} rad about a second axis, {options.min_second_turn_rad:.2f} are needed; "
                "turn the vehicle about two axes"
            )
        sigma = options.pixel_sigma / self._calibration.cameras[0].model.focal_px
        return self._judge(solve(chain, sigma, options.bias_gyro_sigma))

    def _judge(self, solution: Solution) -> CameraRotation:
        """Refuse what the tracks contradict; the scatter they show stands in for the noise that was assumed."""
        if not solution.misfit <= _MAX_MISFIT:
            raise RefusalError(f"the tracks disagree with the gyroscope by {solution.misfit:.1f} times their noise")
        bias = float(np.linalg.norm(solution.bias_gyro_B))
        if not bias <= 3.0 * self._options.bias_gyro_sigma:
            raise RefusalError(f"gyroscope bias of {bias:.2f} rad/s is not plausible")
        scatter = max(solution.misfit, _LEAST_MISFIT) ** 2 * np.linalg.inv(solution.information)
        found = CameraRotation(solution.R_BC, scatter + np.eye(3) * np.deg2rad(_SYSTEMATIC_DEG) ** 2)
        if not found.sigma_deg <= self._options.max_camera_rotation_sigma_deg:
            raise RefusalError(
                f"the camera's rotation is known to {found.sigma_deg:.2f} deg only (standard deviation); "
                "turn the vehicle about two axes"
            )
        if not solution.settled:
            raise RefusalError("the refinement of the camera's rotation did not settle")
        return found
