"""A scene turned into shapes, with widths that suit the view it is drawn for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.geometry.trajectory import Trajectory
from vioframe.report.scene import Flight, Scene
from vioframe.report.scene_grid import Grid, axes_shape, grid_shape
from vioframe.report.scene_shapes import (
    Shape,
    balls,
    creases,
    dashes,
    facing,
    polyline,
    pyramid_edges,
    rods,
    thinned,
)
from vioframe.report.scene_view import View
from vioframe.report.style import colour
from vioframe.types import Calibration, Float

TRUTH_RGB = (0.12, 0.12, 0.12)
_EDGE_RGB = (0.62, 0.64, 0.68)
_WORLD_RGB = (0.87, 0.88, 0.90)

# Widths in pixels of a picture that is 1000 of them high.
_PATH, _TRUTH, _EDGE, _GRID, _AXIS, _LANDMARK, _START = 5.0, 5.6, 1.7, 1.5, 4.0, 4.6, 15.0
_DASH_PERIOD = 30.0
_FRUSTUM = 46.0
_FRUSTA = 22


@dataclass(frozen=True, eq=False)
class Drawing:
    """``solid`` shapes, and the faces of the ``world``, turned to the flight: from behind they are hardly to be seen,
    so that nothing that stands between the eye and the flight hides it. ``heights`` m are the ends of the landmarks'
    colours, where those tell heights."""

    solid: Shape
    world: Shape
    heights: tuple[float, float] | None


def draw(scene: Scene, grid: Grid, view: View) -> Drawing:
    """All of ``scene`` as seen in ``view``."""
    px = view.width_m
    heights = _heights(scene)
    parts = [grid_shape(grid, 0.5 * _GRID * px), axes_shape(grid, 0.5 * _AXIS * px)]
    parts += [_truth(truth, px) for truth in scene.truths]
    for flight in scene.flights:
        parts += [_path(flight, px), _landmarks(flight, heights, view)]
        if flight.calibration is not None:
            parts.append(cameras(flight, flight.calibration, px))
    world = Shape.join([])
    if scene.world is not None:
        world = Shape.of(facing(scene.world, scene.path.mean(axis=0)), _WORLD_RGB)
        parts.append(rods(*creases(scene.world), 0.5 * _EDGE * px, _EDGE_RGB))
    return Drawing(Shape.join(parts), world, heights)


def rgb(number: int) -> tuple[float, float, float]:
    """The palette's colour of a run."""
    code = colour(number)
    red, green, blue = (int(code[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return red, green, blue


def height_colours(heights: Float) -> Float:
    """(N, 3) of heights scaled to 0 to 1."""
    from matplotlib import colormaps

    # The bright end of the map is lost on white.
    return np.asarray(colormaps["viridis"](0.92 * np.clip(heights, 0.0, 1.0)))[:, :3]


def _path(flight: Flight, px: float) -> Shape:
    estimate = flight.estimate
    pieces = [thinned(piece, 0.5 * _PATH * px) for piece in np.split(estimate.p_WB, flight.breaks)]
    tubes = [polyline(piece, 0.5 * _PATH * px, rgb(flight.number)) for piece in pieces]
    return Shape.join([*tubes, balls(estimate.p_WB[:1], 0.5 * _START * px, rgb(flight.number), fine=True)])


def _truth(truth: Trajectory, px: float) -> Shape:
    # Dashes around the estimates leave both to be seen where they agree, from wherever one looks.
    return dashes(thinned(truth.p_WB, _TRUTH * px), 0.5 * _TRUTH * px, _DASH_PERIOD * px, TRUTH_RGB)


def cameras(flight: Flight, calibration: Calibration, px: float) -> Shape:
    """The edges of what the camera saw, at poses evenly along the path."""
    estimate, camera = flight.estimate, calibration.cameras[0].model
    spacing = max(estimate.path_length_m / _FRUSTA, 1.5 * _FRUSTUM * px)
    poses = estimate.select(np.unique(np.searchsorted(estimate.travelled_m, _steps(estimate.path_length_m, spacing))))
    width, height = camera.resolution
    corners_px = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]) - 0.5
    rays_C = np.concatenate([corners_px, np.ones((4, 1))], axis=1) @ np.linalg.inv(camera.K).T
    base_C = rays_C * (_FRUSTUM * px * camera.fx / width)
    R_WC = poses.R_WB @ calibration.cameras[0].R_BC
    apex_W = poses.p_WB + poses.R_WB @ calibration.cameras[0].p_BC
    base_W = apex_W[:, None] + base_C @ R_WC.transpose(0, 2, 1)
    pale = 0.35 + 0.65 * np.array(rgb(flight.number))
    return rods(*pyramid_edges(apex_W, base_W), 0.5 * _EDGE * px, pale)


def _steps(length: float, spacing: float) -> Float:
    return np.arange(0.0, length, spacing) if length > spacing else np.zeros(1)


def _landmarks(flight: Flight, heights: tuple[float, float] | None, view: View) -> Shape:
    """Balls of one size in the picture; by height, or in the run's colour where there are several runs."""
    p_WF = flight.landmarks.p_WF if flight.landmarks is not None else np.empty((0, 3))
    # What is right before the eye would only stand in the way.
    depth = view.depth(p_WF)
    ahead = depth > 0.3 * view.depth(view.target)
    p_WF, depth = p_WF[ahead], depth[ahead]
    if heights is None:
        colours = np.broadcast_to(0.25 + 0.75 * np.array(rgb(flight.number)), p_WF.shape)
    else:
        colours = height_colours((p_WF[:, 2] - heights[0]) / (heights[1] - heights[0]))
    return balls(p_WF, 0.5 * _LANDMARK * view.scale * depth / view.focal_px, colours)


def _heights(scene: Scene) -> tuple[float, float] | None:
    if sum(flight.landmarks is not None for flight in scene.flights) != 1:
        return None
    low, high = np.percentile(scene.near_landmarks[:, 2], [3.0, 97.0])
    return float(low), float(max(high, low + 0.1))
