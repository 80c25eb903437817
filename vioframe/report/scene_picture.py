"""A drawing as an image, by casting rays: it needs neither a display nor a graphics driver, and is always the same."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry.meshes import import_open3d, ray_scene
from vioframe.report.scene_drawing import Drawing
from vioframe.report.scene_shapes import Shape
from vioframe.report.scene_view import View
from vioframe.types import Float, Image

Float32 = NDArray[np.float32]

# A pixel is the mean over a rotated grid: no two samples share a row or a column.
_SAMPLES_PX = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])
_ROWS = 64
_MAX_LAYERS = 8
# How much of what is behind them the world's faces hide, seen from the side of the flight and from the other.
_SURFACE_OPACITY, _BACK_OPACITY = 0.6, 0.05
_LIGHT_W = np.array([0.35, 0.2, 0.92])


def render(drawing: Drawing, view: View) -> Image:
    """(height, width, 3), on white."""
    width, height = view.size
    solid, world = _Layer(drawing.solid, view), _Layer(drawing.world, view)
    image = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, height))
        xy = np.stack(np.meshgrid(np.arange(width), rows), axis=-1).reshape(-1, 2)
        light = np.mean([_light(solid, world, view, xy + offset) for offset in _SAMPLES_PX], axis=0)
        image[rows] = np.round(255.0 * np.clip(light, 0.0, 1.0)).reshape(len(rows), width, 3)
    return image


class _Layer:
    """Shapes that rays can hit."""

    def __init__(self, shape: Shape, view: View) -> None:
        self._o3d = import_open3d("a picture of a flight")
        self._eye = view.eye
        corners = shape.corners - view.eye
        self._scene = ray_scene(corners) if len(corners) else None
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._normals = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)).astype(np.float32)
        self._colour = shape.colour.astype(np.float32)

    def first_hit(self, directions: Float32, beyond: Float32) -> tuple[Float32, Any]:
        """The depth (N,) of what each ray hits first after the depth ``beyond``, infinite for nothing, and which."""
        if self._scene is None:
            return np.full(len(directions), np.inf, np.float32), np.zeros(len(directions), np.intp)
        rays = np.concatenate([directions * beyond[:, None], directions], axis=1)
        hit = self._scene.cast_rays(self._o3d.core.Tensor.from_numpy(rays))
        return beyond + hit["t_hit"].numpy(), hit["primitive_ids"].numpy()

    def facing(self, which: Any, directions: Float32) -> Float32:
        """(N,) cosine between the outside of each triangle and the way back along the ray."""
        cosine = -np.einsum("ij,ij->i", self._normals[which], directions)
        return np.asarray(cosine / np.linalg.norm(directions, axis=1))

    def colour(self, which: Any) -> Float32:
        return np.asarray(self._colour[which])

    def lit(self, which: Any) -> Float32:
        """(N,) how much light from above falls on each triangle's outside, -1 to 1."""
        return np.asarray(self._normals[which] @ _LIGHT_W.astype(np.float32))


def _light(solid: _Layer, world: _Layer, view: View, xy: Float) -> Float32:
    """(N, 3) along the rays through ``xy`` (N, 2) px."""
    directions = view.directions(xy).astype(np.float32)
    depth, which = solid.first_hit(directions, np.zeros(len(xy), np.float32))
    behind = np.ones((len(xy), 3), np.float32)
    hit = np.isfinite(depth)
    # Lit from the eye: what faces it has its own colour, as in the legend.
    shade = 0.55 + 0.45 * np.abs(solid.facing(which[hit], directions[hit]))
    behind[hit] = solid.colour(which[hit]) * shade[:, None]
    return _through(world, directions, depth, behind)


def _through(world: _Layer, directions: Float32, depth: Float32, behind: Float32) -> Float32:
    """What is ``behind`` (N, 3) at ``depth`` (N,), seen through the faces of the world before it."""
    light, left = np.zeros_like(behind), np.ones(len(behind), np.float32)
    alive = np.arange(len(behind))
    at = np.zeros(len(behind), np.float32)
    for _ in range(_MAX_LAYERS):
        at, which = world.first_hit(directions[alive], at)
        before = at < depth[alive] * (1.0 - 1e-4)
        alive, at, which = alive[before], at[before], which[before]
        if not len(alive):
            break
        opacity = np.where(world.facing(which, directions[alive]) > 0.0, _SURFACE_OPACITY, _BACK_OPACITY)
        shade = 0.93 + 0.07 * world.lit(which)
        light[alive] += (left[alive] * opacity * shade)[:, None] * world.colour(which)
        left[alive] *= 1.0 - opacity
        at = at * np.float32(1.0 + 1e-5) + np.float32(1e-5)
    return light + left[:, None] * behind
