"""Random views of an image: the homographies of training and validation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Float


@dataclass(frozen=True, slots=True)
class HomographyRange:
    """How far a random homography may go; defaults as published for KeypointNet."""

    patch_ratio: float = 0.7
    """Side of the part of the image that is seen, which leaves room for the rest; then it fills the view."""
    perspective: float = 0.2
    """Largest shift of the corners as a share of the view, two standard deviations; never beyond the image's edge."""
    rotation_deg: float = 45.0
    scale: tuple[float, float] = (0.9, 1.1)


def random_homography(rng: np.random.Generator, size: tuple[int, int], limits: HomographyRange) -> Float:
    """(3, 3) from pixels of an image of ``size`` (width, height) to pixels of a view of the same size."""
    ratio, free = limits.patch_ratio, 0.5 * (1.0 - limits.patch_ratio)
    patch = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * ratio
    # Symmetric along x, free along y: what a camera does that is turned away about its axes.
    most = min(limits.perspective, free)
    lean = np.clip(rng.normal(0.0, most / 2.0, 3), -most, most)
    patch += np.array([[lean[1], lean[0]], [lean[2], -lean[0]], [lean[2], lean[0]], [lean[1], -lean[0]]])
    patch *= rng.uniform(*limits.scale)
    angle = np.deg2rad(rng.uniform(-limits.rotation_deg, limits.rotation_deg))
    aspect = np.array([size[0] / size[1], 1.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    patch = patch * aspect @ turn.T / aspect
    room = np.maximum(0.0, 0.5 - np.abs(patch).max(axis=0))
    patch += rng.uniform(-room, room)
    scale = np.asarray(size) - 1.0
    return homography_of((patch + 0.5) * scale, np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * scale)


def random_affine(rng: np.random.Generator, angle_deg: float, flip: bool, size: tuple[int, int]) -> Float:
    """(3, 3) a turn about the middle of an image of ``size`` (width, height) and, if asked, at times its mirror."""
    angle = np.deg2rad(rng.uniform(-angle_deg, angle_deg))
    mirror = -1.0 if flip and rng.random() < 0.5 else 1.0
    middle = 0.5 * (np.asarray(size) - 1.0)
    A = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([mirror, 1.0])
    out = np.eye(3)
    out[:2, :2], out[:2, 2] = A, middle - A @ middle
    return out


def homography_of(source: Float, target: Float) -> Float:
    """(3, 3) that takes four points (4, 2) to four others; Hartley and Zisserman, section 4.1."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    h = np.linalg.solve(np.array(rows), np.asarray(target, np.float64).ravel())
    return np.append(h, 1.0).reshape(3, 3)
