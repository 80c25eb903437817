"""The window: its states, readings and tracks, and what they say together. Frames come and go here and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vioframe.arrays import Bool
from vioframe.estimation import rig
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.landmarks import (
    camera_poses,
    image_velocities,
    in_hosts,
    in_images,
    motion_in_body,
    positions,
    triangulate_tracks,
)
from vioframe.estimation.factors.problem import (
    INFINITELY_FAR,
    STATE_SIZE,
    Normal,
    Prior,
    Problem,
    Variables,
    marginalise_oldest,
)
from vioframe.estimation.factors.reprojection import (
    CALIBRATION_SIZE,
    FIXED_LENS,
    GLOBAL_SHUTTER,
    INTRINSICS,
    OFFSET,
    READOUT,
    Calibrated,
    Lens,
    Shutter,
    Sightings,
    pixels_by_intrinsics,
    pixels_by_residual,
)
from vioframe.estimation.factors.solver import covariance, solve
from vioframe.estimation.factors.tracks import LandmarkTable, TrackTable
from vioframe.estimation.inertial.noise import noise_over
from vioframe.estimation.inertial.preintegration import EXACT, Preintegrated, join_segments, preintegrate
from vioframe.estimation.point_noise import PointNoise
from vioframe.estimation.repeats import Repeats
from vioframe.estimation.standstill import TREMBLE, Standstill
from vioframe.geometry.cameras import intrinsics_of
from vioframe.geometry.kernels import undistorted
from vioframe.geometry.two_view import rays
from vioframe.types import (
    NS_PER_S,
    UNKNOWN_READOUT_S,
    CalibrationEstimate,
    CameraSigma,
    Float,
    FrameTracks,
    ImuSegment,
    Int,
    NavState,
    Start,
)
from vioframe_sliding_window.options import SlidingWindowOptions

# What a step must lower the cost by for another to follow: 4 is sqrt(8) standard deviations of all unknowns together,
# and the next frame begins where this one ended.
_DECREASE = 4.0
# Biases that moved farther from those the readings were integrated with have them integrated anew, rad/s and m/s^2.
_REPROPAGATE_GYRO, _REPROPAGATE_ACCEL = 0.01, 0.1


class Window:
    """K states, the newest last, and all factors between them.

    It begins with one state, whose covariance is the first prior, and the tracks of its frame.
    """

    def __init__(self, start: Start, options: SlidingWindowOptions) -> None:
        state, calibration = start.state, start.calibration.calibration
        self._given = calibration
        self._noise_at_rest, self._noise = start.noise_at_rest, calibration.imu
        self._options = options
        self._focal_px = np.array([camera.model.focal_px for camera in calibration.cameras])
        self.point_noise = PointNoise(options.pixel_sigma)
        self._worth = worth_of_weights(options.cauchy_sigmas)
        self._t_ns = [state.t_ns]
        self._states = StateArrays.stack([state])
        self._gyro_B = start.imu.gyro_B[-1:]
        self._models = np.array([intrinsics_of(camera.model)[0] for camera in calibration.cameras])
        self._cameras = Calibrated.of(*calibration.cameras)
        unknown_s = options.calibrate_readout * UNKNOWN_READOUT_S
        sigma = tuple(replace(s, readout_s=s.readout_s or unknown_s) for s in start.calibration.sigma)
        cov = rig.covariance(replace(start.calibration, sigma=sigma))
        self._calibrated = np.tile(_calibrated(options), len(sigma)) & (np.diag(cov) > 0.0)
        cov[~self._calibrated], cov[:, ~self._calibrated] = 0.0, 0.0
        self._camera_sigma = np.sqrt(np.diag(cov))
        self._prior = Prior.of(state, self._cameras, cov)
        self._readings: list[Preintegrated] = []
        self._still: dict[int, Standstill] = {}
        self._newest_is_keyframe = True
        self._cov = state.cov
        self._undistorted_with = np.empty((0, 8))  # each view's points
        self.tracks = LandmarkTable(len(sigma))
        self._repeats = Repeats(len(sigma), options.shared_every_s)
        self._add_tracks(start.tracks)

    def __len__(self) -> int:
        return len(self._t_ns)

    @property
    def newest(self) -> NavState:
        """The newest state, with covariance."""
        return replace(self._states[-1:].unstack(np.array(self._t_ns[-1:]))[0], cov=self._cov)

    @property
    def cameras(self) -> Calibrated:
        return self._cameras

    def calibration(self) -> CalibrationEstimate:
        """What is believed of the calibration by now."""
        learned, sigmas, x = self._given, self._camera_sigma.reshape(-1, CALIBRATION_SIZE), self._cameras
        for c, given in enumerate(self._given.cameras):
            learned = learned.with_camera(
                c,
                model=given.model.with_intrinsics(x.intrinsics[c]),
                R_BC=x.R_BC[c],
                p_BC=x.p_BC[c],
                time_offset_ns=self._given.cameras[0].time_offset_ns + round(x.offset_s[c] * NS_PER_S),
                readout_s=float(x.readout_s[c]),
            )
        return CalibrationEstimate(learned, tuple(map(CameraSigma.of, sigmas)))

    @property
    def prior(self) -> Prior:
        return self._prior

    def predict(self, imu: ImuSegment) -> NavState:
        """Where the readings lead from the newest state, with covariance."""
        return self._integrated(imu, EXACT).predict(self.newest)

    def _integrated(self, imu: ImuSegment, sigma_first: Float) -> Preintegrated:
        """The readings behind the newest state, at its biases, from within ``sigma_first`` (9,) of it."""
        newest, noise = self._states[-1:], noise_over(imu, self._noise_at_rest, self._noise)
        return preintegrate(imu, newest.bias_gyro_B[0], newest.bias_accel_B[0], noise, sigma_first)

    def add_frame(self, imu: ImuSegment, predicted: NavState, tracks: FrameTracks) -> None:
        """Append the frame that ``imu`` leads to from the newest one, which gives way if it is no keyframe."""
        if not self._newest_is_keyframe:
            imu = join_segments([self._readings[-1].imu, imu])
            self._drop_newest()
        self._readings.append(self._integrated(imu, TREMBLE if len(self) - 1 in self._still else EXACT))
        self._t_ns.append(predicted.t_ns)
        self._states = self._states.append(StateArrays.stack([predicted]))
        self._gyro_B = np.concatenate([self._gyro_B, imu.gyro_B[-1:]])
        self._prior = self._prior.with_state(self._states)
        self._add_tracks(tracks)
        self._newest_is_keyframe = False

    def _add_tracks(self, tracks: FrameTracks) -> None:
        on_sphere, lenses = self._options.residual == "sphere", list(enumerate(self._cameras.intrinsics))
        if self._varies_lens:
            xy_normalised = np.empty_like(tracks.xy_normalised)
            for c, lens in lenses:
                own = tracks.camera == c
                xy_normalised[own] = undistorted(int(self._models[c]), lens, tracks.xy[own])
            tracks = replace(tracks, xy_normalised=xy_normalised).finite()
        self._undistorted_with = np.concatenate([self._undistorted_with, self._cameras.intrinsics])
        to_px = np.empty((len(tracks.ids), 2, 2))
        for c, lens in lenses:
            own = tracks.camera == c
            to_px[own] = pixels_by_residual(int(self._models[c]), lens, tracks.xy_normalised[own], on_sphere)
        at = self.tracks.add_frame(tracks, self._repeats.counting(tracks))
        self.tracks.to_px[at], self.tracks.untold[at] = to_px, 1.0

    @property
    def is_full(self) -> bool:
        """Whether the oldest state has to go before another frame comes: cameras that take turns have as many each."""
        if not self._newest_is_keyframe:
            return False
        return bool(self.tracks.taking_part().sum(axis=0).max() > self._options.window_size)

    def choose_keyframe(self) -> bool:
        """Decide whether the newest frame stays in the window, and say so."""
        if not self._newest_is_keyframe:
            options = self._options
            R_WC, _ = camera_poses(self._states, self._cameras)
            common, moved_px = parallax(self.tracks, R_WC, self._focal_px)
            self._newest_is_keyframe = (
                moved_px >= options.keyframe_parallax_px or common < options.keyframe_min_tracks or self._is_due()
            )
        return self._newest_is_keyframe

    def _is_due(self) -> bool:
        """Whether the interval is over since a camera of the newest frame last had a part in one, if it ever had."""
        taking_part = self.tracks.taking_part()
        before = np.flatnonzero((taking_part[:-1] & taking_part[-1]).any(axis=1))
        interval_ns = self._options.keyframe_interval_s * NS_PER_S
        return not len(before) or self._t_ns[-1] - self._t_ns[before[-1]] >= interval_ns

    def hold_still(self, t_ns: int, still: Standstill) -> None:
        """The body has not moved from the newest state until ``t_ns``, which the readings ``still`` bear out."""
        k = len(self) - 1
        self._still[k] = self._still[k].and_then(still) if k in self._still else still
        self._t_ns[-1] = t_ns
        self._newest_is_keyframe = True

    def _drop_newest(self) -> None:
        self.tracks.drop_frame(len(self) - 1)
        self._t_ns.pop()
        self._readings.pop()
        self._states, self._gyro_B = self._states[:-1], self._gyro_B[:-1]
        self._undistorted_with = self._undistorted_with[: -self.tracks.cameras]
        self._prior = self._prior.without_newest()

    def triangulate(self) -> None:
        """Find the landmarks of tracks that have been seen often enough."""
        tracks = self.tracks
        rows = np.flatnonzero(~tracks.known & (tracks.lengths() >= self._options.min_observations))
        sigma = self.point_noise.px / self._focal_px[0]
        known, landmarks = triangulate_tracks(
            self._states, self._cameras, tracks.seen[rows], tracks.xy_normalised[rows], sigma, self._shutter(rows)
        )
        tracks.landmarks[rows], tracks.known[rows] = landmarks, known

    def repropagate(self) -> None:
        """Integrate readings anew where the biases have moved far from those they were integrated with."""
        for k, reading in enumerate(self._readings):
            gyro, accel = self._states.bias_gyro_B[k], self._states.bias_accel_B[k]
            if (
                np.linalg.norm(gyro - reading.bias_gyro_B) > _REPROPAGATE_GYRO
                or np.linalg.norm(accel - reading.bias_accel_B) > _REPROPAGATE_ACCEL
            ):
                self._readings[k] = reading.repropagated(gyro, accel)

    def optimise(self) -> tuple[int, int]:
        """Move states, calibration and landmarks to where all factors agree best, and drop tracks that do not fit.

        Returns how many of these the newest frame saw, and of how many.
        """
        options, rows = self._options, np.flatnonzero(self.tracks.known)
        solution = solve(
            self._problem(self._readings, self._still, self._sightings(rows)),
            self._variables(rows),
            self._active(),
            options.max_iterations,
            decrease=_DECREASE,
            max_seconds=1e-3 * options.max_solve_ms,
        )
        x = solution.variables
        self._states, self._cameras, self.tracks.landmarks[rows] = x.states, x.cameras, x.landmarks
        self._cov, self._camera_sigma = self._covariance(solution.normal)
        errors = solution.normal.errors
        bad = errors * self.point_noise.px > options.outlier_px
        views = self.tracks.lengths()[rows[~bad]]
        self.point_noise.add(2.0 * views * errors[~bad] ** 2, views)
        newest = self.tracks.in_sight()[rows]
        self.tracks.drop(rows[bad])
        return int((bad & newest).sum()), int(newest.sum())

    @property
    def in_sight(self) -> int:
        """Number of known landmarks that the newest frame sees."""
        return int((self.tracks.known & self.tracks.in_sight()).sum())

    def landmarks(self) -> tuple[Int, Float]:
        """Ids (L,) and positions p_WF (L, 3) m of the known landmarks that are not infinitely far."""
        rows = np.flatnonzero(self.tracks.known & (self.tracks.landmarks[:, 2] > INFINITELY_FAR))
        p_WF = positions(self._states, self._cameras, self.tracks.hosts[rows], self.tracks.landmarks[rows])
        return self.tracks.ids[rows], p_WF

    def marginalise_oldest(self) -> None:
        """Turn what the oldest state and the landmarks it hosts say about the rest into the prior, and let go of it.

        Landmarks that are still in sight move to the next frame that saw them, and tell a share of each sighting: an
        equal one each time until its frame goes, by when it has been told once. The others tell all that is untold.
        Each counts for what the estimate knows by it, which is more than its weight.
        """
        tracks = self.tracks
        rows = np.flatnonzero(tracks.known & (tracks.hosts < tracks.cameras))
        told, stays = tracks.untold[rows], tracks.in_sight()[rows]
        told[stays] /= 1.0 + np.arange(tracks.seen.shape[1]) // tracks.cameras
        still = {k: still for k, still in self._still.items() if k == 0}
        sightings = self._sightings(rows)._replace(share=self._worth * told)
        problem = self._problem(self._readings[:1], still, sightings)
        self._prior = marginalise_oldest(problem, self._variables(rows))
        tracks.untold[rows] -= told
        staying = rows[stays]
        ids, hosts, landmarks = tracks.ids[staying], tracks.hosts[staying], tracks.landmarks[staying]
        p_WF = positions(self._states, self._cameras, hosts, landmarks)
        tracks.drop(rows[~stays])
        tracks.drop_frame(0)
        self._t_ns.pop(0)
        self._readings.pop(0)
        self._states, self._gyro_B = self._states[1:], self._gyro_B[1:]
        self._undistorted_with = self._undistorted_with[tracks.cameras :]
        self._still = {k - 1: still for k, still in self._still.items() if k > 0}
        self._host_again(ids, p_WF)

    def _host_again(self, ids: Int, p_WF: Float) -> None:
        """Express landmarks at ``p_WF`` (N, 3) m in the views that now host them, where two or more see them."""
        tracks = self.tracks
        _, rows, of = np.intersect1d(tracks.ids, ids, assume_unique=True, return_indices=True)
        enough = tracks.seen[rows].sum(axis=1) >= 2
        rows, p_WF = rows[enough], p_WF[of[enough]]
        tracks.landmarks[rows], tracks.known[rows] = in_hosts(self._states, self._cameras, tracks.hosts[rows], p_WF)

    def _variables(self, rows: Int) -> Variables:
        return Variables(self._states, self._cameras, self.tracks.landmarks[rows])

    def _problem(self, readings: list[Preintegrated], still: Mapping[int, Standstill], sightings: Sightings) -> Problem:
        return Problem(
            self._prior, ImuFactors.stack(readings), still, sightings, self._options.first_estimate_jacobians
        )

    def _sightings(self, rows: Int) -> Sightings:
        options, tracks = self._options, self.tracks
        xy, depth = in_images(self._states, self._cameras, tracks.hosts[rows], tracks.landmarks[rows])
        velocity = image_velocities(self._states, self._cameras, self._gyro_B, xy, depth)
        return Sightings(
            tracks.seen[rows],
            tracks.untold[rows],
            tracks.xy_normalised[rows],
            velocity,
            tracks.to_px[rows],
            self.point_noise.px,
            options.cauchy_sigmas,
            options.residual == "sphere",
            self._shutter(rows),
            self._lens(tracks.seen[rows], xy),
        )

    def _shutter(self, rows: Int) -> Shutter:
        if not (self._cameras.readout_s.any() or self._calibrated[READOUT::CALIBRATION_SIZE].any()):
            return GLOBAL_SHUTTER
        y, N = self.tracks.xy[rows, :, 1], self.tracks.cameras
        row = np.empty_like(y)
        for c, camera in enumerate(self._given.cameras):
            row[:, c::N] = camera.row(y[:, c::N])
        return Shutter(True, row, *motion_in_body(self._states, self._gyro_B))

    @property
    def _varies_lens(self) -> bool:
        return bool(self._calibrated[INTRINSICS].any())  # of the first camera, and so of all

    def _lens(self, seen: Bool, xy: Float) -> Lens:
        if not self._varies_lens:
            return FIXED_LENS
        px = pixels_by_intrinsics(self._models, self._cameras.intrinsics, xy, seen)
        return Lens(True, px, self._undistorted_with)

    def _active(self) -> Int:
        """The entries of the error vector that are estimated."""
        return np.flatnonzero(np.append(np.ones(STATE_SIZE * len(self), bool), self._calibrated))

    def _covariance(self, normal: Normal) -> tuple[Float, Float]:
        """Of the newest state (15, 15), and the standard deviations of the calibration, zero where it is fixed."""
        end = covariance(normal, self._active(), STATE_SIZE + int(self._calibrated.sum()))
        sigma = np.zeros(len(self._calibrated))
        sigma[self._calibrated] = np.sqrt(np.diag(end)[STATE_SIZE:])
        return end[:STATE_SIZE, :STATE_SIZE], sigma


def _calibrated(options: SlidingWindowOptions) -> Bool:
    """(16,) what of a camera's calibration is to be estimated unless it is known for sure."""
    out = np.empty(CALIBRATION_SIZE, bool)
    out[:OFFSET], out[OFFSET] = options.calibrate_extrinsics, options.calibrate_time_offset
    out[READOUT], out[INTRINSICS] = True, options.calibrate_intrinsics
    return out


def worth_of_weights(cauchy: float) -> float:
    """What an estimate by Cauchy's loss at ``cauchy`` standard deviations is worth, over what its weights add up to.

    They are w = 1 / (1 + x / cauchy^2), x being the squared length of a residual of two entries. The loss has the
    curvature E[w^2] on average and its gradient the variance E[x w^2] / 2, where Gauss-Newton's matrix has E[w].
    """
    n = 10_000
    x = -2.0 * np.log1p(-(np.arange(n) + 0.5) / n)  # equally likely values
    w = 1.0 / (1.0 + x / cauchy**2)
    return float((w**2).mean() ** 2 / (0.5 * (x * w**2).mean() * w.mean()))


def parallax(tracks: TrackTable, R_WC: Float, focal_px: Float) -> tuple[int, float]:
    """Number of tracks that the newest frame has in common with those before, and their mean motion since, px.

    For each camera, of focal length ``focal_px`` (N,), the frame before is the last in which it saw anything, or just
    the last. The rotation is taken out: ``R_WC`` (V, 3, 3) is that of every view.
    """
    N, last = tracks.cameras, tracks.in_view.shape[1]
    common, moved_px = np.zeros(len(tracks.ids), bool), [np.empty(0)]
    for c in range(N):
        now, earlier = last - N + c, np.arange(last - 2 * N + c, -1, -N)
        before = next((v for v in earlier if tracks.in_view[:, v].any()), earlier[0])
        both = tracks.in_view[:, before] & tracks.in_view[:, now]
        turned = rays(tracks.xy_normalised[both, now]) @ (R_WC[before].T @ R_WC[now]).T
        ahead = turned[:, 2] > 0.0
        moved = turned[ahead, :2] / turned[ahead, 2:] - tracks.xy_normalised[both, before][ahead]
        moved_px.append(focal_px[c] * np.linalg.norm(moved, axis=1))
        common |= both
    mean_px = np.concatenate(moved_px).mean() if any(map(len, moved_px)) else np.inf if common.any() else 0.0
    return int(common.sum()), float(mean_px)
