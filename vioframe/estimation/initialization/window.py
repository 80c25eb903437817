"""What an initialisation is made from, frames with their tracks as arrays, and what it comes to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from vioframe.arrays import Bool
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, Calibrated
from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.hand_eye import BIAS_SIGMA
from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.geometry import so3
from vioframe.geometry.two_view import rays
from vioframe.types import CameraOnBody, Float, FrameTracks, ImuSegment, Int, NavState

Packet = tuple[ImuSegment, FrameTracks]

PIXEL_SIGMA = 1.0
"""Standard deviation of an observation, px, as long as none has been found, and at most."""
BIAS_GYRO_SIGMA, BIAS_ACCEL_SIGMA = BIAS_SIGMA, 0.15
"""Priors of the biases about zero, rad/s and m/s^2; those of EuRoC's IMU are 0.08 and 0.13."""
LARGEST_IMU_GAP_S = 0.1
"""A longer stretch without readings begins everything anew."""
# Tracks that two frames must have in common. Four unknowns, the way between them and the unit of length, are theirs.
_FEWEST_LINKS = 8


@dataclass(frozen=True, slots=True)
class InitialEstimate:
    """Where an estimator begins, in a world with z up whose origin and yaw zero are those of the first state.

    ``states`` are the window's frames, oldest first. The last is the newest frame and has ``cov`` (15, 15), with
    position and yaw, which nothing measures, pinned at that frame. ``landmark_ids`` (L,) and ``p_WF`` (L, 3) m are the
    landmarks that were used; ``cameras``, of covariance ``cov_cameras`` (16, 16), is what it saw them with.
    """

    method: Literal["static", "stereo", "dynamic"]
    states: tuple[NavState, ...]
    landmark_ids: Int = field(default_factory=lambda: np.empty(0, np.int64))
    p_WF: Float = field(default_factory=lambda: np.empty((0, 3)))
    cameras: Calibrated | None = None
    cov_cameras: Float = field(default_factory=lambda: np.zeros((CALIBRATION_SIZE, CALIBRATION_SIZE)))


class RefusalError(Exception):
    """An attempt came to nothing; the message says why in one line. Never leaves the package."""


class UnsureError(RefusalError):
    """An attempt that is not sure enough of itself: more of the same motion may make it so."""


class ContradictedError(RefusalError):
    """What was seen and felt speaks against the calibration, and for ``cameras``, of covariance ``cov`` (16, 16)."""

    def __init__(self, cameras: Calibrated, cov: Float) -> None:
        super().__init__("images and readings contradict the calibration")
        self.cameras, self.cov = cameras, cov


def refuse_unless(good: object, why: str) -> None:
    """Raise :class:`RefusalError` saying ``why`` where something is not as it must be; a NaN never compares as good."""
    if not good:
        raise RefusalError(why)


@dataclass(frozen=True, slots=True)
class Window:
    """K keyframes, the readings between them, and L tracks over the V = K N views of N ``cameras``.

    ``t_ns`` (K,), ``segments`` K - 1, ``ids`` (L,). ``xy`` (V, L, 2) are points on the z = 1 plane, as :func:`unrolled`
    leaves them, NaN where ``seen`` (V, L) is False; ``xy_px`` (V, L, 2) the pixels. A frame's views are together.
    """

    t_ns: Int
    segments: tuple[ImuSegment, ...]
    ids: Int
    xy: Float
    seen: Bool
    xy_px: Float
    cameras: int = 1

    def only(self, keep: Bool) -> Window:
        """The same window with the tracks ``keep`` (L,)."""
        seen, xy, xy_px = self.seen[:, keep], self.xy[:, keep], self.xy_px[:, keep]
        return replace(self, ids=self.ids[keep], seen=seen, xy=xy, xy_px=xy_px)

    def without_last(self) -> Window:
        """The same tracks without the newest keyframe."""
        earlier = slice(0, -self.cameras)
        seen, xy, xy_px = self.seen[earlier], self.xy[earlier], self.xy_px[earlier]
        return replace(self, t_ns=self.t_ns[:-1], segments=self.segments[:-1], seen=seen, xy=xy, xy_px=xy_px)

    def of_camera(self, camera: int) -> Window:
        """The same tracks as one of the cameras sees them."""
        own = slice(camera, None, self.cameras)
        return replace(self, seen=self.seen[own], xy=self.xy[own], xy_px=self.xy_px[own], cameras=1)


def unrolled(tracks: FrameTracks, camera: CameraOnBody, rate_B: Float) -> FrameTracks:
    """``tracks`` as they were at the frame's stamp, but for the way flown meanwhile; ``rate_B`` (3,) rad/s turns them.

    With a global shutter, or a camera of which nobody knows how it is turned, they are left as they are.
    """
    if not camera.readout_s or not camera.rotation_known:
        return tracks
    late_s = camera.readout_s * camera.row(tracks.xy[:, 1])
    turned = (so3.exp(late_s[:, None] * (rate_B @ camera.R_BC)) @ rays(tracks.xy_normalised)[..., None])[..., 0]
    return replace(tracks, xy_normalised=turned[:, :2] / turned[:, 2:])


def seen_anew(tracks: FrameTracks, camera: CameraOnBody, rate_B: Float) -> FrameTracks:
    """``tracks`` as ``camera`` saw them, which is another than the one they were undistorted and unrolled for."""
    return unrolled(tracks.undistorted(camera.model).finite(), camera, rate_B)


def linked(before: FrameTracks, after: FrameTracks) -> bool:
    """Whether enough of what one frame shows is in the other for the way between them, and its unit, to be known."""
    return len(np.intersect1d(before.ids, after.ids)) >= _FEWEST_LINKS


def build_window(
    packets: Sequence[Packet], chosen: Sequence[int], min_views: int, max_landmarks: int, cameras: int = 1
) -> Window:
    """The frames ``chosen``, ascending indices of ``packets``, and the best of the tracks in ``min_views`` or more."""
    tracks = [packets[k][1] for k in chosen]
    segments = tuple(join_segments([imu for imu, _ in packets[a + 1 : b + 1]]) for a, b in pairwise(chosen))
    table = TrackTable(cameras)
    for frame in tracks:
        table.add_frame(frame)
    rows = np.flatnonzero(table.lengths() >= min_views)
    rows = rows[_most_telling(table.seen[rows], max_landmarks)]
    seen = table.seen[rows].T
    xy = np.where(seen[..., None], np.swapaxes(table.xy_normalised[rows], 0, 1), np.nan)
    xy_px = np.swapaxes(table.xy[rows], 0, 1)
    return Window(np.array([t.t_ns for t in tracks]), segments, table.ids[rows], xy, seen, xy_px, cameras)


def _most_telling(seen: Bool, count: int) -> Int:
    """At most ``count`` ascending rows of ``seen`` (L, V): long tracks, and those in views that few others are in.

    The longest alone would leave views out where the body turns fast. So a view is worth the less to a track the more
    of those taken before are in it, and the track that is worth most is taken next; the older of equals.
    """
    if len(seen) <= count:
        return np.arange(len(seen))
    left, tracks = seen.astype(np.float64), np.zeros(seen.shape[1])
    rows = []
    for _ in range(count):
        rows.append(int((left @ (1.0 / (1.0 + tracks))).argmax()))
        tracks += left[rows[-1]]
        left[rows[-1]] = 0.0
    return np.sort(rows)


def spread_indices(t_ns: Int, count: int) -> list[int]:
    """At most ``count`` ascending indices of ``t_ns``, first and last among them, evenly spaced in time."""
    wanted = np.linspace(t_ns[0], t_ns[-1], count)
    nearest = np.abs(t_ns[:, None] - wanted).argmin(axis=0)
    return [int(k) for k in np.unique(nearest)]
