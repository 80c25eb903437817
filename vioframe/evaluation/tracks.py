"""How long the front-end's tracks live, and how far they stray from their landmarks, in a world that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.geometry.meshes import ray_scene
from vioframe.geometry.trajectory import Trajectory
from vioframe.geometry.two_view import rays
from vioframe.types import CameraOnBody, Float, FrameTracks, Int


@dataclass(frozen=True, slots=True)
class TrackLives:
    """N tracks, each of a landmark that the world's surface has where the track was found."""

    images: Int
    """(N,) in how many each was followed, the one that it was found in left out; to the end where it was not lost."""
    drift_px: Float
    """(N,) RMS distance in these from where the landmark truly is; NaN for a track that was lost at once."""


def track_lives(
    steps: Sequence[FrameTracks], ground_truth: Trajectory, camera: CameraOnBody, corners: Float
) -> TrackLives:
    """The lives of the tracks of one ``camera``, in a world of triangles ``corners`` (T, 3, 3) m.

    ``ground_truth`` covers all ``steps``. The shutter is taken for a global one. Left out: tracks that were found where
    the camera sees no surface.
    """
    truth = ground_truth.at([step.t_ns for step in steps])
    R_WC, p_WC = camera.pose(truth.R_WB, truth.p_WB)
    p_WF = landmarks_of(steps, R_WC, p_WC, corners)
    images, squared_px = np.full(len(p_WF), -1), np.zeros(len(p_WF))
    for tracks, R, p in zip(steps, R_WC, p_WC, strict=True):
        off_px = camera.model.project((p_WF[tracks.ids] - p) @ R) - tracks.xy
        images[tracks.ids] += 1
        squared_px[tracks.ids] += np.sum(off_px**2, axis=1)  # where it was found none
    known = np.isfinite(squared_px)
    images, squared_px = images[known], squared_px[known]
    mean_px = np.full(len(images), np.nan)
    np.divide(squared_px, images, out=mean_px, where=images > 0)
    return TrackLives(images, np.sqrt(mean_px))


def landmarks_of(steps: Sequence[FrameTracks], R_WC: Float, p_WC: Float, corners: Float) -> Float:
    """(K, 3) m where tracks of a camera lie on the surface of triangles ``corners`` (T, 3, 3), by their ids below K.

    That is where they were found, the camera's poses in the ``steps`` being (S, 3, 3) and (S, 3). NaN where it saw no
    surface, and for ids that are no track.
    """
    scene = ray_scene(corners)
    p_WF = np.full((1 + max((int(step.ids.max(initial=-1)) for step in steps), default=-1), 3), np.nan)
    found = np.zeros(len(p_WF), bool)
    for tracks, R, p in zip(steps, R_WC, p_WC, strict=True):
        new = tracks.only(~found[tracks.ids])
        towards = rays(new.xy_normalised) @ R.T
        cast = np.hstack([np.broadcast_to(p, towards.shape), towards]).astype(np.float32)
        depth_m = scene.cast_rays(cast)["t_hit"].numpy().astype(np.float64)
        p_WF[new.ids] = p + np.where(np.isfinite(depth_m), depth_m, np.nan)[:, None] * towards
        found[new.ids] = True
    return p_WF
