"""Where to look at a flight from: a pinhole camera that has all of it in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Float

_FIELD_OF_VIEW_DEG = 32.0
_MARGIN = 0.04
_THREE_QUARTERS_DEG = 25.0
_LEAST_SCALE = 0.6
_CENTRING_STEPS = 10


@dataclass(frozen=True, eq=False)
class View:
    """A camera at ``eye`` (3,) m in W: ``R_VW`` (3, 3) maps to x right, y down, z forward; ``size`` (width, height) px.

    ``target`` (3,) is the middle of what is looked at, where lines have the width that they were asked for.
    """

    R_VW: Float
    eye: Float
    target: Float
    size: tuple[int, int]

    @property
    def focal_px(self) -> float:
        return _focal_px(self.size)

    @property
    def centre_px(self) -> Float:
        """(2,) the middle of the picture; integers are pixel centres."""
        return 0.5 * (np.array(self.size) - 1.0)

    @property
    def scale(self) -> float:
        """Pixels for each that a line or a letter is wide where the picture is 1000 pixels high; a small picture keeps
        them large enough to see."""
        return max(min(self.size) / 1000.0, _LEAST_SCALE)

    @property
    def width_m(self) -> float:
        """What looks one such pixel wide at the target."""
        return self.scale * float(self.depth(self.target)) / self.focal_px

    def depth(self, p_W: Float) -> Float:
        """(...,) m along the line of sight of points (..., 3)."""
        return np.asarray((p_W - self.eye) @ self.R_VW[2])

    def project(self, p_W: Float) -> Float:
        """(N, 2) px of points (N, 3) in front of the eye."""
        p_V = (p_W - self.eye) @ self.R_VW.T
        return np.asarray(self.focal_px * p_V[:, :2] / p_V[:, 2:] + self.centre_px)

    def directions(self, xy: Float) -> Float:
        """(N, 3) in W through pixels (N, 2), of unit depth."""
        ahead = np.concatenate([(xy - self.centre_px) / self.focal_px, np.ones((len(xy), 1))], axis=1)
        return np.asarray(ahead @ self.R_VW)


def view_of(points: Float, azimuth_deg: float, elevation_deg: float, size: tuple[int, int]) -> View:
    """The nearest view that has ``points`` (N, 3), not all in one place, in the picture with a margin.

    ``azimuth_deg`` is where the eye stands, counter-clockwise from x seen from above; ``elevation_deg`` how high.
    """
    a, e = np.radians([azimuth_deg, elevation_deg])
    ahead = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    R_VW = np.stack([right, np.cross(ahead, right), ahead])
    low, high = points.min(axis=0), points.max(axis=0)
    q = points @ R_VW.T
    # A point is in the picture where |x - ex| <= k (z - ez): the eye lies where the tightest planes of both sides meet.
    k = (1.0 - 2.0 * _MARGIN) * 0.5 * np.array(size) / _focal_px(size)
    right_most = np.max(q[:, :2] - k * q[:, 2:], axis=0)
    left_most = np.max(-q[:, :2] - k * q[:, 2:], axis=0)
    ez = float(np.min(-(right_most + left_most) / (2.0 * k)))
    eye_V = np.array([*(0.5 * (right_most - left_most)), ez])
    # That is the middle of the tighter direction; in the other, move until there is as much room on both sides.
    for _ in range(_CENTRING_STEPS):
        seen = (q[:, :2] - eye_V[:2]) / (q[:, 2:] - ez)
        eye_V[:2] += 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * (q[:, 2].mean() - ez)
    return View(R_VW, R_VW.T @ eye_V, 0.5 * (low + high), size)


def best_azimuth_deg(path: Float, scenery: Float) -> float:
    """From where a path (N, 3) m shows most: broadside on, a little to the side, with the ``scenery`` (M, 3) behind."""
    centred = path[:, :2] - path[:, :2].mean(axis=0)
    if len(scenery) and np.ptp(path, axis=0).max() < 0.25:
        # A body that hardly moved is seen over its shoulder.
        side = np.median(scenery[:, :2], axis=0) - path[:, :2].mean(axis=0)
    else:
        side = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        if len(scenery) and (np.median(scenery[:, :2], axis=0) - path[:, :2].mean(axis=0)) @ side < 0.0:
            side = -side
    return float(np.degrees(np.arctan2(-side[1], -side[0]))) + _THREE_QUARTERS_DEG


def _focal_px(size: tuple[int, int]) -> float:
    return 0.5 * min(size) / float(np.tan(np.radians(0.5 * _FIELD_OF_VIEW_DEG)))
