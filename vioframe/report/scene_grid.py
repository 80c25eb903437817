"""The net on the ground that tells sizes and directions, and the axes along its edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.report.scene import Scene
from vioframe.report.scene_shapes import Shape, rods
from vioframe.types import Float

AXES_RGB = {"x": (0.80, 0.18, 0.18), "y": (0.18, 0.58, 0.22), "z": (0.16, 0.36, 0.80)}
_GRID_RGB = (0.80, 0.81, 0.83)
_LINES = 8.0
_LEAST_M = 0.5


@dataclass(frozen=True, eq=False)
class Grid:
    """From ``low`` to ``high`` (2,) m at the height ``z_m``, with lines at the multiples of ``step_m`` between."""

    step_m: float
    low: Float
    high: Float
    z_m: float

    def ticks(self, axis: int) -> Float:
        first = np.ceil(self.low[axis] / self.step_m - 1e-6)
        last = np.floor(self.high[axis] / self.step_m + 1e-6)
        return np.asarray(np.arange(first, last + 1.0) * self.step_m)

    @property
    def corners(self) -> Float:
        """(4, 3)."""
        (x0, y0), (x1, y1) = self.low, self.high
        return np.array([[x, y, self.z_m] for x in (x0, x1) for y in (y0, y1)])

    @property
    def margin(self) -> Float:
        """(4, 3) corners of the area that labels beside the grid take."""
        labels = 0.6 * self.step_m
        return Grid(self.step_m, self.low - labels, self.high + labels, self.z_m).corners

    def nearest_corner(self, eye: Float) -> Float:
        """(3,)."""
        return np.asarray(self.corners[np.argmin(np.linalg.norm(self.corners - eye, axis=1))])

    @property
    def axes(self) -> tuple[Float, Float]:
        """The foot (3,) and the tips (3, 3) of axes along the grid's edges."""
        return self.corners[0], self.corners[0] + 0.8 * self.step_m * np.eye(3)


def ground_grid(scene: Scene) -> Grid:
    """On the floor of the world; without one, below what is of interest, and as far as it reaches."""
    points = scene.of_interest
    low, high = points.min(axis=0), points.max(axis=0)
    # Around a body at rest there is some room, too.
    room = 0.5 * np.maximum(_LEAST_M - (high - low), 0.0)
    low, high = low - room * [1.0, 1.0, 0.0], high + room * [1.0, 1.0, 0.0]
    step = _round_number(float(np.max((high - low)[:2])) / _LINES)
    if scene.world is not None:
        return Grid(step, low[:2], high[:2], float(low[2]))
    # A few landmarks below the ground do not lower it.
    ground = min(float(np.percentile(points[:, 2], 2.0)), float(scene.path[:, 2].min()))
    return Grid(step, np.floor(low[:2] / step) * step, np.ceil(high[:2] / step) * step, ground)


def grid_shape(grid: Grid, radius_m: float) -> Shape:
    # Lying on the ground rather than half in it.
    z_m = grid.z_m + 1.5 * radius_m
    lines = []
    for axis in (0, 1):
        at = np.unique([grid.low[axis], *grid.ticks(axis), grid.high[axis]])
        a = np.full((len(at), 3), z_m)
        a[:, axis], a[:, 1 - axis] = at, grid.low[1 - axis]
        b = a.copy()
        b[:, 1 - axis] = grid.high[1 - axis]
        lines.append(rods(a, b, radius_m, _GRID_RGB))
    return Shape.join(lines)


def axes_shape(grid: Grid, radius_m: float) -> Shape:
    foot, tips = grid.axes
    return Shape.join(
        rods(foot[None], tip[None], radius_m, colour) for tip, colour in zip(tips, AXES_RGB.values(), strict=True)
    )


def _round_number(x: float) -> float:
    """1, 2 or 5 times a power of ten, the next above ``x``."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= x * (1.0 - 1e-9)))
