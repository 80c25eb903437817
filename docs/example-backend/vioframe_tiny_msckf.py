"""A back-end in one file: a multi-state constraint Kalman filter in its shortest form.

Mourikis and Roumeliotis, "A multi-state constraint Kalman filter for vision-aided inertial navigation", ICRA 2007.
The error state is [dtheta dp dv dbg dba | dtheta dp of each pose in the window]. Landmarks are no part of it: a track
that has ended is triangulated, and what its rows say of the landmark itself is projected out.
"""

from dataclasses import replace
from typing import Annotated

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from vioframe.estimation.inertial.noise import noise_over
from vioframe.estimation.inertial.propagation import propagate
from vioframe.estimation.standstill import Standstill
from vioframe.geometry.so3 import exp, hat
from vioframe.geometry.triangulation import triangulate
from vioframe.parts.hooks import hookimpl
from vioframe.types import DBA, DBG, DP, DTHETA, DV, Estimate, Float, FrameTracks, ImuSegment, Start, Status


class TinyMsckf:
    """The MSCKF without what makes it fast, or consistent in yaw: to be read, and to begin from."""

    def __init__(
        self,
        *,
        window: Annotated[int, "poses kept"] = 8,
        pixel_sigma: Annotated[float, "standard deviation of a tracked point, px"] = 1.0,
    ) -> None:
        self._window, self._pixel_sigma = window, pixel_sigma

    def begin(self, start: Start) -> None:
        """Forget all that was before, and begin at ``start``."""
        rig = start.calibration.calibration
        camera = rig.single("tiny_msckf")
        self._R_BC, self._p_BC, self._sigma = camera.R_BC, camera.p_BC, self._pixel_sigma / camera.model.fx
        self._noise, self._noise_at_rest = rig.imu, start.noise_at_rest
        self._state, self._P = start.state, start.state.cov
        self._R_WB, self._p_WB = np.empty((0, 3, 3)), np.empty((0, 3))  # the window's poses, oldest first
        self._seen: list[dict[int, Float]] = []  # what each of them sees: points on the z = 1 plane, by track

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """Propagate, clone, update from the tracks that have ended or fill the window, let the oldest pose go."""
        if still and self._hold_still(imu):
            return Estimate(Status.TRACKING, replace(self._state, t_ns=tracks.t_ns, cov=self._P[:15, :15]))
        self._propagate(imu, tracks.t_ns)
        self._clone(tracks)
        full = len(self._seen) > self._window
        ended = set().union(*self._seen) - self._seen[-1].keys() | (self._seen[0].keys() if full else set())
        landmarks = {track: p_WF for track in sorted(ended) if (p_WF := self._update_from(track)) is not None}
        if full:
            self._R_WB, self._p_WB, self._seen = self._R_WB[1:], self._p_WB[1:], self._seen[1:]
            self._P = np.delete(np.delete(self._P, np.s_[15:21], axis=0), np.s_[15:21], axis=1)
        ids, p_WF = np.array([*landmarks], np.int64), np.reshape([*landmarks.values()], (-1, 3))
        state = replace(self._state, cov=self._P[:15, :15])
        return Estimate(Status.TRACKING, state, ids, p_WF, corrected=bool(landmarks))

    def _propagate(self, imu: ImuSegment, t_ns: int) -> None:
        s = self._state
        step = propagate(
            imu,
            s.R_WB,
            s.p_WB,
            s.v_WB,
            s.bias_gyro_B,
            s.bias_accel_B,
            noise_over(imu, self._noise_at_rest, self._noise),
        )
        Phi = block_diag(step.transition, np.eye(len(self._P) - 15))
        self._P = Phi @ self._P @ Phi.T
        self._P[:15, :15] += step.noise
        self._state = replace(s, t_ns=t_ns, R_WB=step.R_WB, p_WB=step.p_WB, v_WB=step.v_WB)

    def _clone(self, tracks: FrameTracks) -> None:
        J = np.vstack([np.eye(len(self._P)), np.eye(6, len(self._P))])
        self._P = J @ self._P @ J.T
        self._R_WB, self._p_WB = np.vstack([self._R_WB, [self._state.R_WB]]), np.vstack([self._p_WB, self._state.p_WB])
        self._seen.append(dict(zip(tracks.ids.tolist(), tracks.xy_normalised, strict=True)))

    def _update_from(self, track: int) -> Float | None:
        """Use one track up; where its landmark is, or None where nothing could be learned from it."""
        poses = [pose for pose, seen in enumerate(self._seen) if track in seen]
        xy = np.array([self._seen[pose].pop(track) for pose in poses])
        R_WB, p_WB, m = self._R_WB[poses], self._p_WB[poses], len(poses)
        good, p_WF = triangulate(R_WB @ self._R_BC, R_WB @ self._p_BC + p_WB, xy, self._sigma)
        if m < 3 or not good:
            return None
        p_BF = np.einsum("mji,mj->mi", R_WB, p_WF - p_WB)
        x, y, z = ((p_BF - self._p_BC) @ self._R_BC).T
        J_C = np.stack([1 / z, 0 * z, -x / z**2, 0 * z, 1 / z, -y / z**2], axis=1).reshape(m, 2, 3)
        J_B = J_C @ self._R_BC.T
        H_f = J_B @ R_WB.transpose(0, 2, 1)
        H = np.zeros((m, 2, len(self._seen), 6))
        H[np.arange(m), :, poses] = np.concatenate([J_B @ hat(p_BF), -H_f], axis=2)
        residual = (xy - np.stack([x / z, y / z], axis=1)).ravel()
        free = np.linalg.qr(H_f.reshape(-1, 3), mode="complete")[0][:, 3:].T  # of the landmark: eq. (22)-(24)
        return p_WF if self._update(free @ H.reshape(2 * m, -1), free @ residual, self._sigma**2, 15) else None

    def _hold_still(self, imu: ImuSegment) -> bool:
        """Zero-velocity update, unless the readings of ``imu`` contradict standstill; pose and velocity stay."""
        s, rest = self._state, Standstill.over(imu, self._noise_at_rest)
        residual = rest.residual(s.R_WB, s.v_WB, s.bias_gyro_B, s.bias_accel_B)
        return self._update(rest.jacobian(s.R_WB, s.v_WB), residual, rest.sigma**2, 0)

    def _update(self, H: Float, residual: Float, variance: float | Float, first: int) -> bool:
        """Kalman update with ``residual`` = H @ error[first:...] + noise; whether it passed the chi-squared test."""
        PH = self._P[:, first : first + H.shape[1]] @ H.T
        S = H @ PH[first : first + H.shape[1]] + variance * np.eye(len(H))
        if not residual @ np.linalg.solve(S, residual) <= chi2.ppf(0.95, len(H)):
            return False
        K = np.linalg.solve(S, PH.T).T
        self._P = self._P - K @ PH.T
        self._P = 0.5 * (self._P + self._P.T)
        error, s = K @ residual, self._state
        self._state = replace(
            s,
            R_WB=s.R_WB @ exp(error[DTHETA]),
            p_WB=s.p_WB + error[DP],
            v_WB=s.v_WB + error[DV],
            bias_gyro_B=s.bias_gyro_B + error[DBG],
            bias_accel_B=s.bias_accel_B + error[DBA],
        )
        dtheta, dp = error[15:].reshape(-1, 2, 3).transpose(1, 0, 2)
        self._R_WB, self._p_WB = self._R_WB @ exp(dtheta), self._p_WB + dp
        return True


@hookimpl
def vioframe_backends():
    return {"tiny_msckf": TinyMsckf}
