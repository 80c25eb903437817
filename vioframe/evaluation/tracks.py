"""How long the front-end's tracks live, and how far they stray from their landmarks, in a world that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.geometry.meshes import ray_scene
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import CameraOnBody, Float, FrameTracks, Int


@dataclass(frozen=True, slots=True)
class TrackLives:
    """N tracks, each of a landmark that the world's surface has where the track was found."""

    images: Int
    """(N,) in how many each was followed, the one that it was found in left out; to the end where it was not lost."""
    drift_px: Float
    """(N,) RMS distance in these from where the landmark truly is; NaN for a track that was lost at once."""


def track_lives(
    steps: Sequence[FrameTracks], ground_truth: Trajectory, camera: CameraOnBody, corners: Float, index: int = 0
) -> TrackLives:
    """The lives of the tracks of ``camera``, at place ``index`` in the rig.

    ``corners`` (T, 3, 3) m are the triangles of the world, ``ground_truth`` covers all ``steps``. The shutter is taken
    for a global one. Left out: tracks that were found where the camera sees no surface.
    """
    truth = ground_truth.at([step.t_ns for step in steps])
    R_WC, p_WC = truth.R_WB @ camera.R_BC, truth.p_WB + truth.R_WB @ camera.p_BC
    middle = 0.5 * (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1)))  # rays are cast in single precision
    scene = ray_scene(corners - middle)
    seen = [step.of_camera(index) for step in steps]
    count = 1 + max((int(tracks.ids.max()) for tracks in seen if len(tracks.ids)), default=-1)
    p_WF, images, squared_px = np.full((count, 3), np.nan), np.full(count, -1), np.zeros(count)
    for tracks, R, p in zip(seen, R_WC, p_WC, strict=True):
        ids = tracks.ids
        new = images[ids] < 0
        ways_W = np.hstack([tracks.xy_normalised[new], np.ones((len(ids[new]), 1))]) @ R.T
        rays = np.hstack([np.broadcast_to(p - middle, ways_W.shape), ways_W]).astype(np.float32)
        depth_m = scene.cast_rays(rays)["t_hit"].numpy().astype(np.float64)
        p_WF[ids[new]] = p + np.where(np.isfinite(depth_m), depth_m, np.nan)[:, None] * ways_W
        images[ids] += 1
        off_px = camera.model.project((p_WF[ids] - p) @ R) - tracks.xy
        squared_px[ids] += np.where(new, 0.0, np.sum(off_px**2, axis=1))
    known = np.isfinite(p_WF).all(axis=1)
    images, squared_px = images[known], squared_px[known]
    drift_px = np.full(len(images), np.nan)
    np.divide(squared_px, images, out=drift_px, where=images > 0)
    return TrackLives(images, np.sqrt(drift_px))
