"""The filter's mean and covariance. This module alone edits the covariance, by the algebra of :mod:`covariance`.

Error state: [imu 15 | cameras 15 or 16 each | clones 6 each | landmarks 3 each] with
imu [dtheta dp dv dbg dba], camera [dtheta_BC dp_BC d_offset d_intrinsics(8)], and d_readout last where one is
estimated, clone [dtheta dp], landmark dp_WF. Other parts of the calibration that are not estimated have zero covariance
and so are never corrected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vioframe import lapack
from vioframe.errors import DivergedError
from vioframe.estimation import rig
from vioframe.estimation.inertial.propagation import propagate, yaw_consistent_transition
from vioframe.estimation.standstill import TREMBLE
from vioframe.geometry import kernels
from vioframe.geometry.cameras import intrinsics_of
from vioframe.types import (
    DBA,
    DBG,
    DP,
    DTHETA,
    DV,
    NS_PER_S,
    UNKNOWN_READOUT_S,
    CalibrationEstimate,
    CameraSigma,
    Float,
    ImuNoise,
    ImuSegment,
    Int,
    NavState,
)
from vioframe_msckf.covariance import inserted, landmark_innovation, only, reduce

IMU = 15
EXTRINSICS, OFFSET, INTRINSICS, READOUT = slice(0, 6), 6, slice(7, 15), 15
"""Where in a camera's block they are."""
# In that order, the places of :meth:`CameraSigma.stacked`: there the readout comes ahead of the intrinsics.
_ORDER = np.array([*range(7), *range(8, 16), 7])


@dataclass(frozen=True, slots=True)
class Poses:
    """The cloned body poses, oldest first, as estimated and as first estimated: (C, 3, 3) and (C, 3).

    ``rate_B`` (C, 3) rad/s and ``velocity_B`` (C, 3) m/s are how the body moved there, in its own frame. They take a
    pose to when a camera saw something: by its time offset, and the row of a rolling shutter.
    """

    R_WB: Float
    p_WB: Float
    R_WB_first: Float
    p_WB_first: Float
    rate_B: Float
    velocity_B: Float

    @classmethod
    def none(cls) -> Poses:
        return cls(*2 * (np.empty((0, 3, 3)), np.empty((0, 3))), *2 * (np.empty((0, 3)),))

    def append(self, R_WB: Float, p_WB: Float, rate_B: Float, velocity_B: Float) -> Poses:
        """With one more pose, which is its own first estimate."""
        return Poses(
            np.concatenate([self.R_WB, R_WB[None]]),
            np.concatenate([self.p_WB, p_WB[None]]),
            np.concatenate([self.R_WB_first, R_WB[None]]),
            np.concatenate([self.p_WB_first, p_WB[None]]),
            np.concatenate([self.rate_B, rate_B[None]]),
            np.concatenate([self.velocity_B, velocity_B[None]]),
        )

    def without_oldest(self) -> Poses:
        return Poses(
            self.R_WB[1:],
            self.p_WB[1:],
            self.R_WB_first[1:],
            self.p_WB_first[1:],
            self.rate_B[1:],
            self.velocity_B[1:],
        )

    def corrected(self, dx: Float) -> Poses:
        """Moved by the error ``dx`` (6 C,)."""
        d = dx.reshape(-1, 6)
        R_WB, p_WB = kernels.turned_by(self.R_WB, d[:, :3]), self.p_WB + d[:, 3:]
        return Poses(R_WB, p_WB, self.R_WB_first, self.p_WB_first, self.rate_B, self.velocity_B)

    def __len__(self) -> int:
        return len(self.p_WB)


class FilterState:
    """Mean, first estimates and covariance of the error-state filter."""

    def __init__(
        self,
        initial: NavState,
        prior: CalibrationEstimate,
        *,
        extrinsics: bool,
        offset: bool,
        intrinsics: bool,
        readout: bool = False,
    ):
        """With covariance, on what of the calibration is to be estimated, too; ``readout`` though it is given."""
        assert initial.cov is not None
        self.R_WB, self.p_WB, self.v_WB = initial.R_WB.copy(), initial.p_WB.copy(), initial.v_WB.copy()
        self.bias_gyro_B, self.bias_accel_B = initial.bias_gyro_B.copy(), initial.bias_accel_B.copy()
        self.first = (self.R_WB, self.p_WB, self.v_WB)
        """Orientation, position and velocity as propagated to the newest frame, before its updates."""

        self._given = prior.calibration
        cameras = prior.calibration.cameras
        self.R_BC, self.p_BC = np.stack([c.R_BC for c in cameras]), np.stack([c.p_BC for c in cameras])
        # Beyond the first camera's time offset as given, which readings were cut by.
        self.offset_s = np.array([(c.time_offset_ns - cameras[0].time_offset_ns) / NS_PER_S for c in cameras])
        self.readout_s = np.array([c.readout_s for c in cameras])
        models, intrinsics_of_each = zip(*(intrinsics_of(c.model) for c in cameras), strict=True)
        self.camera_models, self.intrinsics = np.array(models), np.stack(intrinsics_of_each)
        self.image_heights = np.array([c.model.resolution[1] for c in cameras])
        self.clones = Poses.none()
        self.landmark_ids: NDArray[np.int64] = np.empty(0, np.int64)
        self.p_WF: Float = np.empty((0, 3))
        self.p_WF_first: Float = np.empty((0, 3))

        known = [s if s.readout_s else replace(s, readout_s=readout * UNKNOWN_READOUT_S) for s in prior.sigma]
        self.of_camera = 16 if any(sigma.readout_s for sigma in known) else 15
        """Columns of a camera."""
        self.calibrated = slice(IMU, IMU + len(cameras) * self.of_camera)
        """Columns of all cameras; the clones begin where they end."""
        estimated = np.zeros((len(cameras), 16), bool)
        estimated[:, EXTRINSICS], estimated[:, OFFSET], estimated[:, INTRINSICS] = extrinsics, offset, intrinsics
        estimated[:, READOUT] = True
        order = (len(_ORDER) * np.arange(len(cameras))[:, None] + _ORDER[: self.of_camera]).ravel()
        cov = rig.covariance(replace(prior, sigma=tuple(known)))[np.ix_(order, order)]
        free = estimated[:, : self.of_camera].ravel()
        self.cov: Float = np.zeros((self.calibrated.stop, self.calibrated.stop))
        self.cov[:IMU, :IMU] = initial.cov
        self.cov[IMU:, IMU:] = np.where(np.outer(free, free), cov, 0.0)

    @property
    def landmarks_begin(self) -> int:
        """Column at which the landmarks begin."""
        return self.calibrated.stop + 6 * len(self.clones)

    def nav_state(self, t_ns: int) -> NavState:
        """The body's state as a copy of its own."""
        return NavState(
            t_ns,
            self.R_WB.copy(),
            self.p_WB.copy(),
            self.v_WB.copy(),
            self.bias_gyro_B.copy(),
            self.bias_accel_B.copy(),
            self.cov[:IMU, :IMU].copy(),
        )

    def calibration(self) -> CalibrationEstimate:
        """What is believed of the calibration by now."""
        sigmas = np.sqrt(np.diag(self.cov)[self.calibrated]).reshape(-1, self.of_camera)
        cameras = tuple(
            replace(
                camera,
                model=camera.model.with_intrinsics(self.intrinsics[c]),
                R_BC=self.R_BC[c].copy(),
                p_BC=self.p_BC[c].copy(),
                time_offset_ns=self._given.cameras[0].time_offset_ns + round(self.offset_s[c] * NS_PER_S),
                readout_s=float(self.readout_s[c]),
            )
            for c, camera in enumerate(self._given.cameras)
        )
        return CalibrationEstimate(
            replace(self._given, cameras=cameras),
            tuple(CameraSigma(s[0:3], s[3:6], float(s[6]), s[7:15], float(s[15:].sum())) for s in sigmas),
        )

    def propagate(self, imu: ImuSegment, noise: ImuNoise, first_estimates: bool) -> None:
        """Move the body's state along ``imu``; eq. (10)-(11) of Mourikis and Roumeliotis (2007), block by block."""
        step = propagate(imu, self.R_WB, self.p_WB, self.v_WB, self.bias_gyro_B, self.bias_accel_B, noise)
        if not np.isfinite([step.p_WB, step.v_WB]).all():
            raise DivergedError("the inertial readings lead nowhere finite")
        Phi = step.transition
        end = (step.R_WB, step.p_WB, step.v_WB)
        if first_estimates:
            Phi = yaw_consistent_transition(Phi, self.first, end, imu.duration_s)
        self.R_WB, self.p_WB, self.v_WB = self.first = end
        P = self.cov
        P[:IMU, IMU:] = Phi @ P[:IMU, IMU:]
        P[IMU:, :IMU] = P[:IMU, IMU:].T
        body = Phi @ P[:IMU, :IMU] @ Phi.T + step.noise
        P[:IMU, :IMU] = 0.5 * (body + body.T)

    def drift_biases(self, duration_s: float, noise: ImuNoise) -> None:
        """Let time pass at standstill: pose and velocity stay, the biases walk on."""
        for part, density in ((DBG, noise.gyro_walk), (DBA, noise.accel_walk)):
            index = np.arange(part.start, part.stop)
            self.cov[index, index] += density**2 * duration_s

    def set_off(self) -> None:
        """Leave a standstill, at a velocity that its picture did not show.

        The pose stays what it was: no landmark is known that would tell how it has trembled since.
        """
        index = np.arange(DV.start, DV.stop)
        self.cov[index, index] += TREMBLE[DV] ** 2

    def augment_clone(self, gyro_B: Float) -> None:
        """Clone the body's pose; ``gyro_B`` (3,) rad/s is the rate there, free of bias."""
        pose = slice(DTHETA.start, DP.stop)
        self.cov = inserted(self.cov, self.landmarks_begin, self.cov[pose], self.cov[pose, pose])
        self.clones = self.clones.append(self.R_WB, self.p_WB, gyro_B, self.R_WB.T @ self.v_WB)

    def drop_oldest_clone(self) -> None:
        """Marginalise the oldest clone."""
        self._delete(self.calibrated.stop + np.arange(6))
        self.clones = self.clones.without_oldest()

    def add_landmarks(self, ids: Int, p_WF: Float, p_WF_first: Float, gain: Float, columns: slice, own: Float) -> None:
        """Append landmarks (M, 3) whose errors are ``gain`` (M, 3, k) @ error[columns] + what ``own`` (M, 3, 3) is of.

        ``p_WF_first`` (M, 3) are where the measurements that initialised them were linearised.
        """
        gain = gain.reshape(3 * len(ids), -1)
        cross = gain @ self.cov[columns]
        cov = cross[:, columns] @ gain.T
        for i, block in enumerate(own):
            cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += block
        self.cov = inserted(self.cov, len(self.cov), cross, cov)
        self.landmark_ids = np.concatenate([self.landmark_ids, ids])
        self.p_WF = np.concatenate([self.p_WF, p_WF])
        self.p_WF_first = np.concatenate([self.p_WF_first, p_WF_first])

    def keep_landmarks(self, keep: NDArray[np.bool_]) -> None:
        """Marginalise the landmarks for which ``keep`` (M,) is False."""
        if keep.all():
            return
        gone = np.flatnonzero(~keep)
        self._delete((self.landmarks_begin + 3 * gone[:, None] + np.arange(3)).ravel())
        self.landmark_ids, self.p_WF, self.p_WF_first = self.landmark_ids[keep], self.p_WF[keep], self.p_WF_first[keep]

    def slide_landmarks(self, drift_px: float) -> None:
        """Let each landmark be ``drift_px`` elsewhere: the patch that is followed slides over what it first showed."""
        drift_m = drift_px / self.intrinsics[0, 0] * np.linalg.norm(self.p_WF - self.p_WB, axis=1)
        index = np.arange(self.landmarks_begin, len(self.cov))
        self.cov[index, index] += np.repeat(drift_m**2, 3)

    def update(self, H: Float, residual: Float, columns: slice, R: float | Float) -> None:
        """Kalman update with ``residual`` (m,) = ``H`` (m, k) @ error[columns] + noise of variance ``R``.

        ``R`` is one variance for all rows or (m,) variances. Raises :class:`DivergedError` where the innovation's
        covariance is not positive.
        """
        HP = H @ self.cov[columns]
        S = HP[:, columns] @ H.T
        np.einsum("ii->i", S)[:] += R  # the diagonal, to write to
        self.update_by(HP, S, residual)

    def innovation(
        self, clone: int, landmarks: Int, cameras: Int, blocks: Float, variance: float
    ) -> tuple[Float, Float]:
        """H P (2 M, n) and S (2 M, 2 M) of sightings from ``clone``: of ``landmarks`` (M,), by ``cameras`` (M,).

        ``blocks`` (M, 2, 25) are their Jacobians over [camera 16, clone 6, landmark 3].
        """
        at_camera, at_landmark = IMU + self.of_camera * cameras, self.landmarks_begin + 3 * landmarks
        at_clone = self.calibrated.stop + 6 * clone
        return landmark_innovation(self.cov, blocks, at_camera, self.of_camera, at_clone, at_landmark, variance)

    def update_by(self, HP: Float, S: Float, residual: Float) -> None:
        """The same by ``HP`` (m, n), the Jacobian times the covariance, and the innovation's covariance ``S`` (m, m).

        Both are used up.
        """
        self._correct(reduce(self.cov, HP, S, residual))

    def _correct(self, dx: Float) -> None:
        self.R_WB = self.R_WB @ kernels.exp(dx[DTHETA])
        self.p_WB = self.p_WB + dx[DP]
        self.v_WB = self.v_WB + dx[DV]
        self.bias_gyro_B = self.bias_gyro_B + dx[DBG]
        self.bias_accel_B = self.bias_accel_B + dx[DBA]
        of_cameras = dx[self.calibrated].reshape(-1, self.of_camera)
        self.R_BC = kernels.turned_by(self.R_BC, of_cameras[:, 0:3])
        self.p_BC = self.p_BC + of_cameras[:, 3:6]
        self.offset_s = self.offset_s + of_cameras[:, OFFSET]
        self.intrinsics = self.intrinsics + of_cameras[:, INTRINSICS]
        self.readout_s = self.readout_s + of_cameras[:, READOUT:].sum(axis=1)
        begin, at = self.calibrated.stop, self.landmarks_begin
        self.clones = self.clones.corrected(dx[begin:at])
        self.p_WF = self.p_WF + dx[at:].reshape(-1, 3)
        if not (np.isfinite(dx).all() and (np.diag(self.cov)[:IMU] > 0.0).all()):
            raise DivergedError("the state is not finite or its variances are not positive")

    def _delete(self, index: NDArray[np.intp]) -> None:
        keep = np.ones(len(self.cov), dtype=bool)
        keep[index] = False
        self.cov = only(self.cov, np.flatnonzero(keep))


def compress(H: Float, residual: Float) -> tuple[Float, Float]:
    """An equivalent measurement of at most as many rows as columns, by QR; Mourikis and Roumeliotis (2007), eq. (28).

    The noise of ``residual`` must be white, and stays so.
    """
    rows, columns = H.shape
    if rows <= columns:
        return H, residual
    packed, *_ = lapack.dgeqrf(np.asfortranarray(np.column_stack([H, residual])), overwrite_a=1)
    R = np.triu(packed[:columns])
    return R[:, :columns], R[:, columns]
