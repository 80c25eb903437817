"""The extended Kalman filter: filterpy holds the error state and its covariance, the mean lives on the manifold.

The error is zero whenever nothing is under way, so what is measured, and its derivative, are taken at the mean. Each
update leaves the error in filterpy's ``x``, from where it moves the mean and is set to zero again. Predictions and
changes of variables are filterpy's ``predict`` with the F and Q of what happened, so that every change of the
covariance goes through the library's equations.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from vioframe.errors import DivergedError
from vioframe.estimation.inertial.propagation import propagate
from vioframe.estimation.standstill import Standstill, standstill_gate
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, CameraOnBody, Float, ImuNoise, ImuSegment, NavState
from vioframe_loose_ekf.state import DP_WA, DTHETA_WV, IMU, LOG_SCALE, SIZE, FilterState, VisionPose

# A new vision frame's scale may be wrong by a factor of two before the first pose says what it is.
_NEW_LOG_SCALE_SIGMA = 0.7
# Below this part of the way the camera went according to the readings, its length is not fit to begin with.
_LEAST_AGREEMENT = 0.3


class Fusion:
    """Mean and covariance of body and vision frame."""

    def __init__(self, nav: NavState, camera: CameraOnBody) -> None:
        self._camera = camera
        self.state = FilterState.begin(nav)
        self._kalman = ExtendedKalmanFilter(dim_x=SIZE, dim_z=6)
        self._kalman.x = np.zeros(SIZE)
        self._kalman.P = np.zeros((SIZE, SIZE))
        self._kalman.P[:IMU, :IMU] = nav.cov

    @property
    def cov(self) -> Float:
        """(22, 22), of the error [dtheta dp dv dbg dba | log-scale | dtheta_WV dp_WA]."""
        return np.asarray(self._kalman.P)

    def nav_state(self, t_ns: int) -> NavState:
        s = self.state
        return NavState(t_ns, s.R_WB, s.p_WB, s.v_WB, s.bias_gyro_B, s.bias_accel_B, self.cov[:IMU, :IMU].copy())

    def propagate(self, imu: ImuSegment, noise: ImuNoise) -> None:
        """Follow the readings."""
        s = self.state
        ahead = propagate(imu, s.R_WB, s.p_WB, s.v_WB, s.bias_gyro_B, s.bias_accel_B, noise)
        self.state = replace(s, R_WB=ahead.R_WB, p_WB=ahead.p_WB, v_WB=ahead.v_WB)
        F, Q = np.eye(SIZE), np.zeros((SIZE, SIZE))
        F[:IMU, :IMU], Q[:IMU, :IMU] = ahead.transition, ahead.noise
        self._predict(F, Q)

    def place_vision_frame(self) -> None:
        """V becomes the camera's frame as it is now, of unknown scale; what was known of another V is forgotten."""
        self._tie(VisionPose(np.eye(3), np.zeros(3)), np.zeros((6, 6)))
        self.state = replace(self.state, log_scale=0.0)
        F, Q = np.eye(SIZE), np.zeros((SIZE, SIZE))
        F[LOG_SCALE] = 0.0
        Q[LOG_SCALE, LOG_SCALE] = _NEW_LOG_SCALE_SIGMA**2
        self._predict(F, Q)

    def tie_anew(self, measured: VisionPose, cov: Float, scale_sigma: float) -> None:
        """V lies such that the camera, where it is now, has the pose ``measured`` with noise ``cov`` (6, 6).

        Its scale may have changed by ``scale_sigma``, relative.
        """
        self._tie(measured, cov)
        Q = np.zeros((SIZE, SIZE))
        Q[LOG_SCALE, LOG_SCALE] = scale_sigma**2
        self._predict(np.eye(SIZE), Q)

    def _tie(self, measured: VisionPose, cov: Float) -> None:
        s, R_BC, p_BC = self.state, self._camera.R_BC, self._camera.p_BC
        R_VC = measured.R_VC
        R_WV = s.R_WB @ R_BC @ R_VC.T
        self.state = replace(s, R_WV=R_WV, p_WA=s.p_WB + s.R_WB @ p_BC, p_VA=measured.p_VC)
        F = np.eye(SIZE)
        F[DTHETA_WV] = F[DP_WA] = 0.0
        F[DTHETA_WV, DTHETA] = R_VC @ R_BC.T
        F[DP_WA, DTHETA], F[DP_WA, DP] = -s.R_WB @ so3.hat(p_BC), np.eye(3)
        # Noise of the measured rotation turns V in the camera's axes, that of the position moves the anchor.
        G = np.zeros((SIZE, 6))
        G[DTHETA_WV, 0:3], G[DP_WA, 3:6] = R_VC, R_WV / s.scale
        self._predict(F, G @ cov @ G.T)

    def begin_scale(self, p_VC: Float) -> bool:
        """Take the scale from how far the readings say the camera has come; False where they say nothing like it."""
        s = self.state
        p_AC = s.R_WV.T @ (s.p_WB + s.R_WB @ self._camera.p_BC - s.p_WA)
        moved_V = p_VC - s.p_VA
        along = float(p_AC @ moved_V) / float(moved_V @ moved_V)
        if along * np.linalg.norm(moved_V) < _LEAST_AGREEMENT * np.linalg.norm(p_AC):
            return False
        self.state = replace(s, log_scale=-float(np.log(along)))
        return True

    def move_anchor(self, p_VA: Float, drift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Tie V to W at its point ``p_VA`` (3,) from now on.

        V has drifted by ``drift``, standard deviations of [log-scale, rotation, position] about the new anchor: rad,
        and units of V.
        """
        s = self.state
        along_W = s.R_WV @ (p_VA - s.p_VA) / s.scale
        F = np.eye(SIZE)
        F[DP_WA, LOG_SCALE] = -along_W[:, None]
        F[DP_WA, DTHETA_WV] = -s.R_WV @ so3.hat(p_VA - s.p_VA) / s.scale
        self.state = replace(s, p_WA=s.p_WA + along_W, p_VA=p_VA)
        sigma = np.zeros(SIZE)
        sigma[LOG_SCALE], sigma[DTHETA_WV], sigma[DP_WA] = drift[0], drift[1], drift[2] / s.scale
        self._predict(F, np.diag(sigma**2))

    def update_pose(self, measured: VisionPose, cov: Float, gate: float) -> bool:
        """Update with a pose of the visual odometry, unless its squared Mahalanobis distance exceeds ``gate``.

        ``cov`` (6, 6) is the noise of [rotation in the camera, position in V].
        """
        residual = measured.beyond(self.state.pose(self._camera))
        return self._update(residual, self.state.pose_jacobian(self._camera), cov, gate)

    def hold_still(self, imu: ImuSegment, noise: ImuNoise) -> bool:
        """Update with the readings of ``imu`` as those of a body at rest, unless they contradict it.

        They serve as measurements here, and so do not propagate the pose as well.
        """
        still, s = Standstill.over(imu, noise), self.state
        residual = still.residual(s.R_WB, s.v_WB, s.bias_gyro_B, s.bias_accel_B)
        H = np.zeros((9, SIZE))
        H[:, :IMU] = still.jacobian(s.R_WB, s.v_WB)
        if not self._update(residual, H, np.diag(still.sigma**2), standstill_gate()):
            return False
        Q = np.zeros((SIZE, SIZE))
        Q[DBG, DBG] = noise.gyro_walk**2 * imu.duration_s * np.eye(3)
        Q[DBA, DBA] = noise.accel_walk**2 * imu.duration_s * np.eye(3)
        self._predict(np.eye(SIZE), Q)
        return True

    def _predict(self, F: Float, Q: Float) -> None:
        self._kalman.F, self._kalman.Q = F, Q
        self._kalman.predict()

    def _update(self, r: Float, H: Float, R: Float, gate: float) -> bool:
        """Update with the residual ``r`` (m,) of noise ``R`` (m, m), unless its squared Mahalanobis distance is beyond
        ``gate``."""
        kalman = self._kalman
        S = H @ kalman.P @ H.T + R
        try:
            distance = float(r @ np.linalg.solve(S, r))
        except np.linalg.LinAlgError as error:
            raise DivergedError("the innovation covariance is singular") from error
        if not np.isfinite(distance) or distance < 0.0:
            raise DivergedError("the innovation covariance is not positive definite")
        if distance > gate:
            return False
        kalman.update(r, lambda _: H, lambda _: np.zeros(len(r)), R=R)
        kalman.P = 0.5 * (kalman.P + kalman.P.T)
        self.state = self.state.retract(kalman.x)
        kalman.x = np.zeros(SIZE)
        if not (np.isfinite(kalman.P).all() and (np.diag(kalman.P)[:IMU] > 0.0).all()):
            raise DivergedError("the covariance is not finite or its variances are not positive")
        return True
