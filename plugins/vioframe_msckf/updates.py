"""The updates: at standstill; from finished tracks, from landmarks in the state, and by taking new landmarks in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.point_noise import PointNoise
from vioframe.estimation.standstill import Standstill
from vioframe.types import DP, Bool, Float, FrameTracks, ImuNoise, ImuSegment, Int
from vioframe_msckf.covariance import distances
from vioframe_msckf.measurement import ACCEPTED, GATED, TrackRows, Window, landmark_blocks, msckf_rows
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.state import IMU, FilterState, compress

# A landmark is taken in once its distance from the body is known to this part. Before, nothing about it is Gaussian,
# and it would never be linearised where it is.
_KNOWN_TO = 0.1


@dataclass(frozen=True, slots=True)
class Selection:
    """Rows of the observation table: tracks to use and let go of now, and full ones that may become landmarks."""

    finished: NDArray[np.intp]
    promoted: NDArray[np.intp]


def hold_still(state: FilterState, imu: ImuSegment, noise: ImuNoise, first_estimates: bool) -> bool:
    """Zero-velocity update, if the readings of ``imu`` agree with standstill; else the state is left as it is.

    The readings serve as measurements here and so do not propagate the pose as well.
    """
    still = Standstill.over(imu, noise)
    residual = still.residual(state.R_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B)
    R_WB, _, v_WB = state.first if first_estimates else (state.R_WB, state.p_WB, state.v_WB)
    H = still.jacobian(R_WB, v_WB)
    if not still.agrees(residual, H, state.cov[:IMU, :IMU]):
        return False
    state.drift_biases(imu.duration_s, noise)
    state.update(H, residual, slice(0, IMU), still.sigma**2)
    return True


def select_tracks(observations: TrackTable, state: FilterState, options: MsckfOptions, full_window: bool) -> Selection:
    """Tracks that were lost or reach back to the oldest clone of a full window, the longest first.

    Lost tracks too short to be used are dropped from the table. Full tracks fill the free landmark slots first.
    """
    lengths = observations.lengths()
    lost = ~observations.in_sight()
    full = observations.reach_back() & ~lost & full_window
    too_short = lost & (lengths < options.min_track_length)
    if too_short.any():
        observations.drop(np.flatnonzero(too_short))
        lengths, lost, full = lengths[~too_short], lost[~too_short], full[~too_short]
    free = max(options.max_slam_features - len(state.landmark_ids), 0)
    candidates = np.flatnonzero(full)
    promoted = candidates[np.argsort(-lengths[candidates], kind="stable")][:free]
    rest = np.setdiff1d(np.flatnonzero(lost | full), promoted)
    # Lost tracks have no second chance, full ones come again with the next frame.
    order = np.lexsort((-lengths[rest], ~lost[rest]))
    return Selection(rest[order][: options.max_features], promoted)


def update_from_tracks(
    state: FilterState,
    observations: TrackTable,
    selection: Selection,
    options: MsckfOptions,
    point_noise: PointNoise,
    gate: Float,
) -> tuple[NDArray[np.intp], Int, Float]:
    """The multi-state constraint update by all tracks of ``selection``, in which those promoted become landmarks.

    Returns the rows used up, accepted or not, and ids and positions of the landmarks of finished tracks accepted.
    Promoted ones whose distance nobody knows yet wait, with as many sightings as the window has.

    Delayed initialisation (Li, "Visual-inertial odometry on resource-constrained systems", 2014): the three rows that
    an orthogonal transformation leaves to a landmark initialise it, the others update the state as any track's do.
    """
    rows, finished = np.concatenate([selection.finished, selection.promoted]), len(selection.finished)
    columns, views = slice(IMU, state.landmarks_begin), observations.lengths()[rows]
    tracks = msckf_rows(
        Window.of(state, options.first_estimate_jacobians),
        observations.xy[rows],
        observations.xy_normalised[rows],
        observations.seen[rows],
        np.ascontiguousarray(state.cov[columns, columns]),
        point_noise.px,
        options.cauchy_sigmas,
        gate,
    )
    accepted, ended = tracks.verdict == ACCEPTED, np.arange(len(rows)) < finished
    taken = _new_landmarks(
        state, observations.ids[rows], tracks, np.flatnonzero(accepted & ~ended), columns, point_noise
    )
    use = accepted & ended
    use[taken] = True
    used = np.repeat(use[accepted], 2 * views[accepted] - 3)
    if used.any():
        state.update(*compress(tracks.H[used], tracks.residual[used]), columns, point_noise.px**2)
    point_noise.add(tracks.squares[ended], views[ended], tracks.ratios[ended])
    gone = ended | use | (tracks.verdict == GATED)
    return rows[gone], observations.ids[rows[accepted & ended]], tracks.p_WF[accepted & ended]


def _new_landmarks(
    state: FilterState, ids: Int, tracks: TrackRows, offered: NDArray[np.intp], columns: slice, point_noise: PointNoise
) -> NDArray[np.intp]:
    """Take those of ``tracks`` that are ``offered`` into the state; returns the ones taken, whose distance is known."""
    T_inverse, p_WF = np.linalg.inv(tracks.T[offered]), tracks.p_WF[offered]
    gain = -T_inverse @ tracks.H_of[offered]
    own = np.asarray(point_noise.px**2 * T_inverse @ np.swapaxes(T_inverse, -1, -2), np.float64)
    # How unsure where it is from the body, not where both are in the world.
    from_body = p_WF - state.p_WB
    J = np.zeros((len(offered), len(state.cov)))
    J[:, columns], J[:, DP] = np.einsum("fi,fik->fk", from_body, gain), -from_body
    unsure = ((J @ state.cov) * J).sum(axis=1) + np.einsum("fi,fij,fj->f", from_body, own, from_body)
    known: Bool = unsure <= (_KNOWN_TO * (from_body**2).sum(axis=1)) ** 2
    if known.any():
        found = p_WF + (T_inverse @ tracks.residual_of[offered, :, None])[..., 0]
        state.add_landmarks(ids[offered[known]], found[known], p_WF[known], gain[known], columns, own[known])
    return offered[known]


class Turns:
    """Which of a rig's cameras have a part in each of the frames of the window, and what each sees in its newest.

    One that sees nothing, while others do, takes its turn in other frames, as :meth:`TrackTable.in_sight` has it.
    """

    def __init__(self, cameras: int) -> None:
        self._newest: list[Int] = [np.empty(0, np.int64)] * cameras
        self._taken = np.empty((0, cameras), dtype=bool)

    def add_frame(self, tracks: FrameTracks) -> None:
        """Append a frame."""
        cameras = np.arange(len(self._newest))
        taking = np.isin(cameras, tracks.camera) if len(tracks.ids) else np.ones(len(cameras), bool)
        self._taken = np.vstack([self._taken, taking])
        # Whose turn does not come within a window has none.
        for c in np.flatnonzero(taking | ~self._taken.any(axis=0)):
            self._newest[c] = tracks.ids[tracks.camera == c]

    def drop_oldest(self) -> None:
        """Forget the oldest frame."""
        self._taken = self._taken[1:]

    @property
    def in_sight(self) -> Int:
        """(N,) ids of what is in sight."""
        return np.concatenate(self._newest)

    @property
    def most(self) -> int:
        """Frames that one camera has a part in, the one that has in most."""
        return int(self._taken.sum(axis=0).max(initial=0))


def update_from_landmarks(
    state: FilterState, tracks: FrameTracks, in_sight: Int, options: MsckfOptions, point_noise: PointNoise, gate: Float
) -> int:
    """Update with the landmarks of the state seen in the newest frame; implausible ones leave, and all not in sight.

    Returns how many were used.
    """
    state.keep_landmarks(np.isin(state.landmark_ids, in_sight))
    if not len(state.landmark_ids):
        return 0
    state.slide_landmarks(options.landmark_drift * point_noise.lasting_px)
    landmarks, rows = np.nonzero(state.landmark_ids[:, None] == tracks.ids)
    if not len(landmarks):
        return 0
    cameras, newest = tracks.camera[rows], len(state.clones) - 1
    blocks, residual = landmark_blocks(
        state, newest, landmarks, cameras, tracks.xy[rows], options.first_estimate_jacobians
    )
    variance = point_noise.px**2
    HP, S = state.innovation(newest, landmarks, cameras, blocks, variance)
    squares = distances(S, residual)
    accepted = squares < gate[2]
    # Cauchy's loss, as for tracks.
    np.einsum("ii->i", S)[:] += np.repeat(variance / options.cauchy_sigmas**2 * squares, 2)
    if accepted.all():
        state.update_by(HP, S, residual)
        return len(accepted)
    if accepted.any():
        use = np.repeat(accepted, 2)
        state.update_by(HP[use], S[np.ix_(use, use)], residual[use])
    implausible = np.setdiff1d(tracks.ids[rows[~accepted]], tracks.ids[rows[accepted]])
    state.keep_landmarks(~np.isin(state.landmark_ids, implausible))
    return int(accepted.sum())
