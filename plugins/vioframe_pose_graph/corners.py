"""Where the corners are that nobody tracks: found again in the keyframes just before, and triangulated from there.

Corners are what one place is best known again by, and a detector need not have chosen any of them to be tracked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vioframe.geometry.resection import resect
from vioframe.geometry.triangulation import triangulate
from vioframe.jit import kernel
from vioframe.types import Float
from vioframe_pose_graph.matching import match
from vioframe_pose_graph.patches import Patches, Picture, laid_over
from vioframe_pose_graph.place import PRIOR, Place, View, depth_sigma_of

# From one keyframe to the next a corner looks much as before.
_MAX_DISTANCE, _RATIO = 48, 0.85
_TOLERATED = 3.0
# Points that must say from where a keyframe before was seen.
_LEAST_KNOWN = 10


def seen_again(view: View, patches: Patches, before: View, picture: Picture, R_CC: Float, apart: float) -> Float:
    """(K, 2) where the keyframe that took ``picture`` just before saw the points of ``view``; NaN where it did not.

    ``R_CC`` (3, 3) leads from the camera of now to that of then, on whose z = 1 plane points closer together than
    ``apart`` may be one.
    """
    target_xy = before.xy_normalised.astype(np.float64)
    found = match(view.descriptors, before.descriptors, target_xy, _MAX_DISTANCE, _RATIO, apart)
    again = np.flatnonzero(found >= 0)
    # Next to one another two keyframes see the same but for how they are turned.
    far = np.zeros(len(again))
    _, warp = laid_over(picture.model, view.xy_normalised[again].astype(np.float64), far, R_CC, np.zeros(3))
    xy = np.full((len(found), 2), np.nan)
    xy[again] = patches.select(again).found_in(picture, picture.model.distort(target_xy[found[again]]), warp)
    return xy


def located(place: Place, view: View, before: Sequence[tuple[Place, Float]], sigma: float) -> View:
    """``view`` with positions of more of its points, as far as they were seen ``before`` from elsewhere, at (K, 2).

    From where that was, those points say of which the position is known: how far the odometry has come since does not
    count, and so corners and landmarks agree. Points are seen to ``sigma`` on the z = 1 plane.
    """
    unknown = np.isnan(view.p_WF[:, 0])
    poses, seen = [(place.R_WC, place.p_WC)], [view.xy_normalised[unknown].astype(np.float64)]
    for at, xy in before:
        both = np.isfinite(xy[:, 0]) & ~unknown
        if np.count_nonzero(both) >= _LEAST_KNOWN:
            known = view.p_WF[both].astype(np.float64)
            poses.append(resect(at.R_WC, at.p_WC, known, xy[both], sigma, 1.0, PRIOR)[:2])
            seen.append(xy[unknown])
    p_WF, depth_sigma = view.p_WF.copy(), view.depth_sigma.copy()
    R_WC, p_WC = (np.stack(parts) for parts in zip(*poses, strict=True))
    p_WF[unknown], parallax = triangulated(R_WC, p_WC, np.stack(seen, axis=1), sigma)
    depth_sigma[unknown] = depth_sigma_of(parallax, sigma)
    return replace(view, p_WF=p_WF, depth_sigma=depth_sigma)


@kernel
def triangulated(R_WC: Float, p_WC: Float, xy: Float, sigma: float) -> tuple[Float, Float]:
    """Positions (N, 3) of points seen at ``xy`` (N, V, 2), NaN where not seen, and by how much their rays diverge, rad.

    NaN and zero where fewer than two of the V cameras saw one, or what they saw is not one point. The angle is the
    largest that any ray makes with the first.
    """
    N, V = xy.shape[:2]
    p_WF, parallax = np.full((N, 3), np.nan), np.zeros(N)
    views = np.empty(V, np.intp)
    for i in range(N):
        count = 0
        for k in range(V):
            if np.isfinite(xy[i, k, 0]):
                views[count] = k
                count += 1
        if count < 2:
            continue
        by = views[:count]
        good, p = triangulate(R_WC[by], p_WC[by], xy[i][by], sigma)
        cosine = 1.0
        first = p - p_WC[by[0]]
        for k in by:
            away = p - p_WC[k]
            x, y, z = R_WC[k].T @ away
            good &= np.hypot(x / z - xy[i, k, 0], y / z - xy[i, k, 1]) < _TOLERATED * sigma
            cosine = min(cosine, (away @ first) / np.sqrt((away @ away) * (first @ first)))
        if good:
            p_WF[i] = p
            parallax[i] = np.arccos(cosine)
    return p_WF, parallax
