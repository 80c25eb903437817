"""The built-in worlds: a hall built around the flight, and the user's own mesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from vioframe.arrays import Float, Image
from vioframe.errors import ConfigError
from vioframe.parts.hooks import hookimpl

if TYPE_CHECKING:
    from vioframe.interfaces import WorldFactory
    from vioframe.simulation.world import MeshBuilder, MeshWorld

_PANEL_M = 4.0
_MARGIN_M = np.array([4.0, 4.0, 1.8])
_CLEARANCE_M = 0.9
_TEXTURES = 16

Images = Annotated[Path | None, "folder of images to texture surfaces with, instead of procedural ones"]


def hall(p_WB: Float, rng: np.random.Generator, *, images: Images = None) -> MeshWorld:
    """A hall with boxes, pillars and pipes around the path (N, 3) m, all clear of it."""
    from vioframe.simulation.world import MeshBuilder, MeshWorld

    textures = _textures(images, rng)
    low, high = p_WB.min(axis=0) - _MARGIN_M, p_WB.max(axis=0) + _MARGIN_M
    builder = MeshBuilder()
    # Thinned to what the clearance can tell apart, whatever the rate of the path.
    path = p_WB[:: max(1, len(p_WB) // 2000)]
    _walls(builder, low, high, rng, len(textures))
    _boxes(builder, low, high, path, rng, len(textures))
    _pillars(builder, low, high, path, rng, len(textures))
    _pipes(builder, low, high, rng, len(textures))
    return MeshWorld(builder.build(), textures)


def mesh(
    p_WB: Float,
    rng: np.random.Generator,
    *,
    file: Annotated[Path, "triangle mesh (PLY, OBJ, STL or OFF), metres, z up"],
    images: Images = None,
    tile_m: Annotated[float, "width of a texture on a surface, m"] = 2.0,
) -> MeshWorld:
    """The triangles of ``file`` as they lie in W; textures are laid on along the axis each face looks to most."""
    from vioframe.geometry.meshes import read_mesh
    from vioframe.simulation.world import MeshWorld
    from vioframe.types import Mesh

    if not tile_m > 0.0:
        raise ConfigError(f"tile_m must be above 0, not {tile_m:g}")
    corners = read_mesh(file)
    textures = _textures(images, rng)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(axis=1)
    plane = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = np.take_along_axis(corners, plane[:, None, :], axis=2) / tile_m
    # Faces that look the same way are one surface.
    _, facing = np.unique(
        np.round(normals / np.linalg.norm(normals, axis=1, keepdims=True), 2), axis=0, return_inverse=True
    )
    surface = facing.ravel().astype(np.int32)
    texture = rng.integers(len(textures), size=surface.max() + 1).astype(np.int32)
    return MeshWorld(Mesh(corners, uv, texture[surface], surface), textures)


def _textures(folder: Path | None, rng: np.random.Generator) -> tuple[Image, ...]:
    from vioframe.simulation.textures import images_as_textures, procedural_textures

    return procedural_textures(rng, _TEXTURES) if folder is None else images_as_textures(folder, rng, _TEXTURES)


def _walls(builder: MeshBuilder, low: Float, high: Float, rng: np.random.Generator, textures: int) -> None:
    """Six walls of panels, no two alike."""
    x, y, z = np.diag(high - low)
    for corner, u, v in ((low, x, z), (low + y, x, z), (low, y, z), (low + x, y, z), (low, x, y), (low + z, x, y)):
        columns, rows = (max(1, round(float(np.linalg.norm(edge)) / _PANEL_M)) for edge in (u, v))
        for i in range(columns):
            for j in range(rows):
                at = corner + u * (i / columns) + v * (j / rows)
                builder.quad(at, u / columns, v / rows, int(rng.integers(textures)), _PANEL_M, rng.random(2))


def _boxes(builder: MeshBuilder, low: Float, high: Float, path: Float, rng: np.random.Generator, textures: int) -> None:
    for _ in range(int(0.35 * np.prod((high - low)[:2]))):
        size = rng.uniform([0.5, 0.5, 0.4], [1.8, 1.8, 2.4])
        bottom = np.append(rng.uniform(low[:2], high[:2] - size[:2]), low[2])
        # Distance from a box: that by which each axis is left of it or right of it.
        outside = np.maximum(np.maximum(bottom - path, path - bottom - size), 0.0)
        if np.linalg.norm(outside, axis=1).min() > _CLEARANCE_M:
            tile_m = float(rng.uniform(1.2, 2.5))
            builder.box(bottom, bottom + size, rng.integers(textures, size=6), tile_m, rng.random(2))


def _pillars(
    builder: MeshBuilder, low: Float, high: Float, path: Float, rng: np.random.Generator, textures: int
) -> None:
    for _ in range(int(0.12 * np.prod((high - low)[:2]))):
        foot, radius_m = rng.uniform(low[:2] + 0.5, high[:2] - 0.5), float(rng.uniform(0.12, 0.35))
        if np.linalg.norm(path[:, :2] - foot, axis=1).min() > _CLEARANCE_M + radius_m:
            start, end = np.append(foot, low[2]), np.append(foot, high[2])
            builder.tube(start, end, radius_m, int(rng.integers(textures)), 2.0, rng.random(2))


def _pipes(builder: MeshBuilder, low: Float, high: Float, rng: np.random.Generator, textures: int) -> None:
    """Along the walls and below the ceiling, within the margin that the flight leaves."""
    for along in (0, 1):
        across = 1 - along
        for wall in (low[across], high[across]):
            inward = 1.0 if wall == low[across] else -1.0
            for _ in range(3):
                radius_m = float(rng.uniform(0.05, 0.16))
                start, end = low.copy(), high.copy()
                start[across] = end[across] = wall + inward * rng.uniform(radius_m + 0.05, 1.0)
                start[2] = end[2] = high[2] - rng.uniform(0.2, 0.5 * (high[2] - low[2]))
                builder.tube(start, end, radius_m, int(rng.integers(textures)), 1.5, rng.random(2))


@hookimpl
def vioframe_worlds() -> Mapping[str, WorldFactory]:
    return {"hall": hall, "mesh": mesh}
