"""What the HPatches protocol measures on two views with a known homography (DeTone et al., CVPRW 2018, appendix).

``H_21`` (3, 3) takes px of view 1 to px of view 2. All distances are taken in view 2, and every figure counts from
view 1 to 2 as from 2 to 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vioframe.bench.detectors.images import corners_of
from vioframe.frontend.distinct import distinct
from vioframe.types import Float, Int, Keypoints

WITHIN_PX = 3.0
"""Two keypoints closer than this are the same."""
APART_PX = 4.0
"""Distinct points are this far from one another."""
CORNERS_WITHIN_PX = (1.0, 3.0, 5.0)
"""A homography is right where it is off by less than this, mean over the corners of the image."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PairScore:
    """One detector on one pair; what cannot be told, as without descriptors, is None."""

    points: float
    """Those that took part, mean of both views."""
    repeatability: float
    distinct: float
    """Repeatability of points 4 px apart: many on one spot find one another with ease and help nobody."""
    localisation_px: float | None
    matching_score: float | None = None
    corner_error_px: float | None = None
    """Infinite where no homography came out."""


def score_pair(first: Keypoints, second: Keypoints, H_21: Float, resolution: tuple[int, int], top_k: int) -> PairScore:
    """All figures for what was found in two views of ``resolution`` (width, height), strongest first.

    Of the points that the other view shows too, the ``top_k`` strongest of either view take part.
    """
    all_1, all_2 = first.xy.astype(np.float64), second.xy.astype(np.float64)
    shared_1 = np.flatnonzero(lands_inside(all_1, H_21, resolution))
    shared_2 = np.flatnonzero(lands_inside(all_2, np.asarray(np.linalg.inv(H_21)), resolution))
    apart_1, apart_2 = (xy[distinct(xy, APART_PX, top_k)] for xy in (all_1[shared_1], all_2[shared_2]))
    keep_1, keep_2 = shared_1[:top_k], shared_2[:top_k]
    xy_1, xy_2 = all_1[keep_1], all_2[keep_2]
    repeatability, localisation_px = repeated(xy_1, xy_2, H_21)
    score = PairScore(
        0.5 * (len(xy_1) + len(xy_2)), repeatability, repeated(apart_1, apart_2, H_21)[0], localisation_px
    )
    if first.descriptors is None or second.descriptors is None:
        return score
    i, j = mutual_matches(first.descriptors[keep_1], second.descriptors[keep_2])
    return replace(
        score,
        matching_score=matching_score(xy_1, xy_2, i, j, H_21),
        corner_error_px=corner_error_px(fit_homography(xy_1[i], xy_2[j]), H_21, resolution),
    )


def warp(H: Float, xy: Float) -> Float:
    """(N, 2) px through ``H`` (3, 3); what it takes to infinity, or beyond, comes out as infinite."""
    homogeneous: Float = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    ahead = homogeneous[:, 2:] > 1e-12
    return np.asarray(np.divide(homogeneous[:, :2], homogeneous[:, 2:], out=np.full((len(xy), 2), np.inf), where=ahead))


def lands_inside(xy: Float, H: Float, resolution: tuple[int, int]) -> Mask:
    """(N,) whether ``H`` takes px (N, 2) into an image of ``resolution`` (width, height)."""
    warped = warp(H, xy)
    return np.asarray(((warped >= 0.0) & (warped <= np.array(resolution) - 1.0)).all(axis=1))


def repeated(xy_1: Float, xy_2: Float, H_21: Float) -> tuple[float, float | None]:
    """Share of all points with one of the other view within 3 px, and the mean distance of those; None without any."""
    if not len(xy_1) or not len(xy_2):
        return 0.0, None
    warped = warp(H_21, xy_1)
    squared = np.subtract.outer(warped[:, 0], xy_2[:, 0]) ** 2 + np.subtract.outer(warped[:, 1], xy_2[:, 1]) ** 2
    nearest = np.sqrt(np.concatenate([squared.min(axis=1), squared.min(axis=0)]))
    again = nearest <= WITHIN_PX
    return float(again.mean()), float(nearest[again].mean()) if again.any() else None


def mutual_matches(descriptors_1: NDArray[np.generic], descriptors_2: NDArray[np.generic]) -> tuple[Int, Int]:
    """Indices (M,), (M,) of points that are each other's nearest: by Hamming distance for bytes, else Euclidean."""
    import cv2

    if not len(descriptors_1) or not len(descriptors_2):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    binary = descriptors_1.dtype == np.uint8
    dtype, norm = (np.uint8, cv2.NORM_HAMMING) if binary else (np.float32, cv2.NORM_L2)
    first, second = (np.asarray(d, dtype, order="C") for d in (descriptors_1, descriptors_2))
    matches = cv2.BFMatcher(norm, crossCheck=True).match(first, second)  # type: ignore[arg-type]
    pairs = np.array([(m.queryIdx, m.trainIdx) for m in matches], np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def matching_score(xy_1: Float, xy_2: Float, i: Int, j: Int, H_21: Float) -> float:
    """Share of the points of a view that are matched, and rightly, within 3 px: the mean over both views."""
    if not len(xy_1) or not len(xy_2):
        return 0.0
    right = int(np.sum(np.linalg.norm(warp(H_21, xy_1[i]) - xy_2[j], axis=1) <= WITHIN_PX))
    return 0.5 * (right / len(xy_1) + right / len(xy_2))


def fit_homography(xy_1: Float, xy_2: Float) -> Float | None:
    """(3, 3) from matches by RANSAC at 3 px, or None where none fits; the same matches give the same answer."""
    import cv2

    if len(xy_1) < 4:
        return None
    H, _ = cv2.findHomography(xy_1, xy_2, cv2.RANSAC, WITHIN_PX)
    return None if H is None else np.asarray(H)


def corner_error_px(H: Float | None, H_21: Float, resolution: tuple[int, int]) -> float:
    """Mean distance of the four corners of view 1 through ``H`` from where they belong; infinite without one."""
    if H is None:
        return np.inf
    corners = corners_of(resolution)
    off = warp(H, corners) - warp(H_21, corners)
    return float(np.linalg.norm(off, axis=1).mean()) if np.isfinite(off).all() else np.inf
