"""The camera's pose from known points: robust least squares from a guess, or from nothing where the guess is bad."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.arrays import Bool
from vioframe.geometry import resection as geometry
from vioframe.types import Float
from vioframe_loose_ekf.state import VisionPose

OUTLIER_SIGMAS = 4.0
"""A point that is off by more is an outlier; at half of that Cauchy's loss has halved its weight."""
_RANSAC_ITERATIONS = 300
_MIN_POINTS = 6


@dataclass(frozen=True, slots=True)
class Resection:
    """A pose, its covariance (6, 6) over [rotation in the camera, position in V] given the points, and inliers (N,)."""

    pose: VisionPose
    cov: Float
    inliers: Bool


def resect(guess: VisionPose, p_VF: Float, xy: Float, sigma: float) -> Resection | None:
    """The pose that sees ``p_VF`` (N, 3) at ``xy`` (N, 2) on the z = 1 plane, near ``guess``; ``sigma`` is their noise.

    None where most points cannot be brought to agree.
    """
    found = _refined(guess, p_VF, xy, sigma)
    if found is not None and found.inliers.sum() > 0.6 * len(xy):
        return found
    start = _ransac(p_VF, xy, sigma)
    again = None if start is None else _refined(start, p_VF, xy, sigma)
    if again is not None and (found is None or again.inliers.sum() > found.inliers.sum()):
        found = again
    return found


def _refined(guess: VisionPose, p_VF: Float, xy: Float, sigma: float) -> Resection | None:
    if len(xy) < _MIN_POINTS:
        return None
    R, p, N, squared = geometry.resect(guess.R_VC, guess.p_VC, p_VF, xy, sigma, 0.5 * OUTLIER_SIGMAS)
    inliers = squared < OUTLIER_SIGMAS**2
    if not np.isfinite(p).all() or inliers.sum() < _MIN_POINTS:
        return None
    try:
        cov = np.linalg.inv(N)
    except np.linalg.LinAlgError:
        return None
    return Resection(VisionPose(R, p), 0.5 * (cov + cov.T), inliers)


def _ransac(p_VF: Float, xy: Float, sigma: float) -> VisionPose | None:
    """By samples of three and a fourth point to choose among their solutions; the same input gives the same pose."""
    import cv2

    if len(xy) < _MIN_POINTS:
        return None
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        np.ascontiguousarray(p_VF),
        np.ascontiguousarray(xy),
        np.eye(3),
        np.empty(0),
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=OUTLIER_SIGMAS * sigma,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or not np.isfinite(translation).all():
        return None
    R_CV = cv2.Rodrigues(rotation)[0]
    return VisionPose(np.asarray(R_CV.T, np.float64), np.asarray(-R_CV.T @ translation[:, 0], np.float64))
