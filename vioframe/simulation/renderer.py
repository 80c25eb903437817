"""A camera in a world: rays through every pixel, distortion included, to light."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.arrays import Bool, Float, Image
from vioframe.geometry.cameras import Camera
from vioframe.interfaces import World
from vioframe.simulation.rasterizer import Faces, Float32, Pyramid, Tiles, draw, see
from vioframe.simulation.world import Movers
from vioframe.types import Int32, Mesh

# A pixel where surfaces meet is the mean over eight places in it, no two of which share a row or a column.
_SAMPLES_PX = (np.array([[k, 3 * k % 8] for k in range(8)]) + 0.5) / 8.0 - 0.5
# Unless the two are as good as equally bright there: 1 is white.
_LEAST_STEP = 3.0 / 255.0
# Height and width; with a rolling shutter every row is seen from a pose of its own.
_TILE_PX = (8, 16)
_TILE_OF_A_ROW_PX = (1, 64)


class Renderer:
    """Renders ``world``, and the ``movers`` in it, through ``camera``.

    ``contrast`` scales what the textures have around their means; ``fog_per_m`` is the extinction of the air.
    """

    def __init__(
        self,
        camera: Camera,
        world: World,
        movers: Movers | None = None,
        *,
        contrast: float = 1.0,
        fog_per_m: float = 0.0,
    ) -> None:
        self._contrast, self._fog_per_m, self._movers = contrast, fog_per_m, movers
        self._focal_px = camera.focal_px
        self._rays = _rays(camera)
        self._tiles, self._tiles_of_rows = (_tiles(self._rays, *size) for size in (_TILE_PX, _TILE_OF_A_ROW_PX))
        self._faces = _faces(world.mesh)
        if movers is not None:
            self._moving = _faces(movers.mesh)
            # Their surfaces are numbered after those of the world.
            self._moving = self._moving._replace(surface=self._moving.surface + self._faces.surface.max() + 1)
        self._pyramid = _mip_pyramid(world.textures)

    def render(self, R_WC: Float, p_WC: Float, p_WM: Float | None = None) -> Float32:
        """Light (height, width), 1 for white in full light, seen from the pose (3, 3), (3,) m.

        For a rolling shutter the pose is one a row: (height, 3, 3) and (height, 3). ``p_WM`` (M, 3) m is where the
        movers are.
        """
        tiles = self._tiles if R_WC.ndim == 2 else self._tiles_of_rows
        poses = np.ascontiguousarray(R_WC).reshape(-1, 3, 3), np.ascontiguousarray(p_WC).reshape(-1, 3)
        faces = self._faces
        if self._movers is not None and p_WM is not None:
            faces = _together(faces, _moved(self._moving, p_WM[self._movers.owner]))
        seen = see(faces, self._pyramid, tiles, *poses, self._focal_px, self._contrast)
        light = np.empty(self._rays.shape[2:], np.float32)
        surface = np.empty(light.shape, np.int32)
        look = seen, faces, self._pyramid, tiles
        draw(*look, self._rays[:1], self._fog_per_m, np.ones(light.shape, np.bool_), light, surface)
        draw(*look, self._rays[1:], self._fog_per_m, _edges(surface, light), light, surface)
        return light


def _rays(camera: Camera) -> Float32:
    """(9, 2, height, width) x and y at z = 1 of the rays through every pixel's middle and eight places in it.

    Between the middles they are interpolated by parabolas: by less than 0.001 px off, up to 85 deg from the axis.
    """
    width, height = camera.resolution
    pixels = np.stack(np.meshgrid(np.arange(-1, width + 1), np.arange(-1, height + 1)), axis=-1).reshape(-1, 2)
    middle = camera.undistort(pixels).T.reshape(2, height + 2, width + 2)
    rays = np.empty((1 + len(_SAMPLES_PX), 2, height, width), np.float32)
    rays[0] = middle[:, 1:-1, 1:-1]
    for ray, (dx, dy) in zip(rays[1:], _SAMPLES_PX, strict=True):
        before, at, behind = _parabola(dy)
        row = before * middle[:, :-2] + at * middle[:, 1:-1] + behind * middle[:, 2:]
        before, at, behind = _parabola(dx)
        ray[:] = before * row[..., :-2] + at * row[..., 1:-1] + behind * row[..., 2:]
    return rays


def _parabola(at: float) -> tuple[float, float, float]:
    """What values at -1, 0 and 1 weigh in the parabola through them."""
    return 0.5 * at * (at - 1.0), 1.0 - at * at, 0.5 * at * (at + 1.0)


def _tiles(rays: Float32, height: int, width: int) -> Tiles:
    rows, columns = (range(0, count, step) for count, step in zip(rays.shape[2:], (height, width), strict=True))
    sides = []
    for xy in (0, 1):
        # A lens may bend rays so far that there are none: NaN.
        for reduce, none in ((np.minimum, np.inf), (np.maximum, -np.inf)):
            of_pixel = reduce.reduce(np.where(np.isnan(rays[:, xy]), none, rays[:, xy]))
            sides.append(reduce.reduceat(reduce.reduceat(of_pixel, rows, axis=0), columns, axis=1))
    return Tiles(np.stack(sides, axis=-1).astype(np.float32), height, width)


def _faces(mesh: Mesh) -> Faces:
    centre = mesh.corners.mean(axis=1)
    radius = np.linalg.norm(mesh.corners - centre[:, None], axis=2).max(axis=1)
    return Faces(
        _exact(mesh.corners),
        np.column_stack([centre, radius]),
        _exact(mesh.normals),
        _exact(mesh.uv),
        _density(mesh),
        mesh.texture.astype(np.int32),
        mesh.surface.astype(np.int32),
    )


def _exact(array: Float) -> Float:
    """As kernels are compiled for it, whatever a plug-in made."""
    return np.array(array, np.float64, order="C")


def _moved(faces: Faces, by: Float) -> Faces:
    """With each triangle moved ``by`` (T, 3) m."""
    spheres = faces.spheres.copy()
    spheres[:, :3] += by
    return faces._replace(corners=faces.corners + by[:, None], spheres=spheres)


def _together(*several: Faces) -> Faces:
    parts: Any = zip(*several, strict=True)
    return Faces(*map(np.concatenate, parts))


def _density(mesh: Mesh) -> Float:
    """(T,) widths of texture a metre: the root of the ratio of the areas."""
    u, v = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    a, b = mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0]
    area = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / np.maximum(area, 1e-12)))


def _edges(surface: Int32, light: Float32) -> Bool:
    """Where a pixel and its right or lower neighbour lie on different surfaces and differ in light, both of them."""
    edges = np.zeros(surface.shape, np.bool_)
    across = (surface[:, 1:] != surface[:, :-1]) & (np.abs(np.diff(light, axis=1)) > _LEAST_STEP)
    down = (surface[1:] != surface[:-1]) & (np.abs(np.diff(light, axis=0)) > _LEAST_STEP)
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def _mip_pyramid(textures: tuple[Image, ...]) -> Pyramid:
    level = np.stack(textures).astype(np.float32)
    size = level.shape[1]
    rows, offsets, total = [], [], 0
    while True:
        offsets.append(total)
        rows.append(np.round(level).astype(np.uint8).ravel())
        total += level.size
        if level.shape[1] == 1:
            return Pyramid(np.concatenate(rows), np.array(offsets), size)
        level = 0.25 * (level[:, ::2, ::2] + level[:, 1::2, ::2] + level[:, ::2, 1::2] + level[:, 1::2, 1::2])
