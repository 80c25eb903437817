"""The shapes that a picture of a flight is made of, all as coloured triangles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from vioframe.types import Float

_SIDES = 8
_CREASE = np.cos(np.radians(25.0))


@dataclass(frozen=True, eq=False)
class Shape:
    """``corners`` (T, 3, 3) m, counter-clockwise from outside, and the ``colour`` (T, 3) of each triangle, 0 to 1."""

    corners: Float
    colour: Float

    @classmethod
    def of(cls, corners: Float, colour: ArrayLike) -> Shape:
        """With one colour for all, (3,), or one each, (T, 3)."""
        return cls(corners, np.broadcast_to(np.asarray(colour, dtype=np.float64), (len(corners), 3)))

    @classmethod
    def join(cls, shapes: Iterable[Shape]) -> Shape:
        shapes = [Shape(np.empty((0, 3, 3)), np.empty((0, 3))), *shapes]
        return cls(np.concatenate([s.corners for s in shapes]), np.concatenate([s.colour for s in shapes]))


def rods(a: Float, b: Float, radius_m: float, colour: ArrayLike) -> Shape:
    """Round rods without lids from each of ``a`` (N, 3) to the same of ``b``; those without length are left out."""
    length = np.linalg.norm(b - a, axis=1)
    a, b, length = (x[length > 0.0] for x in (a, b, length))
    axis = (b - a) / length[:, None]
    other = np.where(np.abs(axis[:, 2:]) > 0.9, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    u = np.cross(axis, other)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    angle = np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
    ring = radius_m * (np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None])
    a0, b0 = a[:, None] + ring, b[:, None] + ring
    a1, b1 = np.roll(a0, -1, axis=1), np.roll(b0, -1, axis=1)
    corners = np.stack([np.stack([a0, a1, b1], axis=2), np.stack([a0, b1, b0], axis=2)], axis=2)
    return Shape.of(corners.reshape(-1, 3, 3), colour)


def balls(centres: Float, radius_m: ArrayLike, colour: ArrayLike, *, fine: bool = False) -> Shape:
    """Icosahedra about ``centres`` (N, 3), radius one for all or (N,), colour (3,) or (N, 3); ``fine``: 16 times
    the facets, for large ones."""
    unit = _icosahedron(2 if fine else 0)
    radius = np.broadcast_to(np.asarray(radius_m, dtype=np.float64), len(centres))
    corners = centres[:, None, None] + radius[:, None, None, None] * unit
    colours = np.broadcast_to(np.asarray(colour, dtype=np.float64), (len(centres), 3))
    return Shape(corners.reshape(-1, 3, 3), np.repeat(colours, len(unit), axis=0))


def polyline(points: Float, radius_m: float, colour: ArrayLike) -> Shape:
    """A tube along ``points`` (N, 3)."""
    return Shape.join([rods(points[:-1], points[1:], radius_m, colour), balls(points, radius_m, colour)])


def dashes(points: Float, radius_m: float, period_m: float, colour: ArrayLike) -> Shape:
    """A dashed tube along ``points`` (N, 3): as much line as gap."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0.0, travelled[-1], period_m / 8.0)
    even = np.stack([np.interp(at, travelled, axis) for axis in points.T], axis=1)
    drawn = np.arange(len(even) - 1) % 8 < 4
    return rods(even[:-1][drawn], even[1:][drawn], radius_m, colour)


def thinned(points: Float, step_m: float) -> Float:
    """``points`` (N, 3) without those that lie within ``step_m`` of the last one kept; the first and last stay."""
    keep = [0]
    for i in range(1, len(points)):
        if np.linalg.norm(points[i] - points[keep[-1]]) >= step_m:
            keep.append(i)
    if keep[-1] != len(points) - 1:
        keep.append(len(points) - 1)
    return np.asarray(points[keep])


def pyramid_edges(apex: Float, base: Float) -> tuple[Float, Float]:
    """Ends (N * 8, 3) of the edges of pyramids with ``apex`` (N, 3) over ``base`` (N, 4, 3)."""
    a = np.concatenate([np.broadcast_to(apex[:, None], base.shape), base], axis=1)
    b = np.concatenate([base, np.roll(base, -1, axis=1)], axis=1)
    return a.reshape(-1, 3), b.reshape(-1, 3)


def creases(corners: Float) -> tuple[Float, Float]:
    """Ends (E, 3) of the edges of a mesh (T, 3, 3) that two faces meet in at an angle, or that bound it."""
    _, vertex = np.unique(corners.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = np.sort(np.concatenate([vertex[:, [0, 1]], vertex[:, [1, 2]], vertex[:, [2, 0]]]), axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    face = np.tile(np.arange(len(corners)), 3)
    _, first, which, times = np.unique(edges, axis=0, return_index=True, return_inverse=True, return_counts=True)
    # Of an edge that two faces share, compare their normals; one that bounds the mesh, or joins more, is drawn.
    other = np.zeros(len(first), dtype=np.intp)
    other[which.ravel()] = np.arange(len(edges))
    flat = np.abs(np.sum(normals[face[first]] * normals[face[other]], axis=1)) > _CREASE
    drawn = ends[first[~((times == 2) & flat)]]
    return drawn[:, 0], drawn[:, 1]


def facing(corners: Float, point: Float) -> Float:
    """``corners`` (T, 3, 3) with each triangle turned so that its outside is on the side of ``point`` (3,)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = np.sum(normals * (point - corners[:, 0]), axis=1) < 0.0
    return np.where(away[:, None, None], corners[:, ::-1], corners)


def _icosahedron(divisions: int) -> Float:
    """(20 * 4^divisions, 3, 3) triangles of the unit sphere, counter-clockwise from outside."""
    g = (1.0 + np.sqrt(5.0)) / 2.0
    v = np.array([[i, j * g, 0.0] for i in (-1.0, 1.0) for j in (-1.0, 1.0)])
    v = np.concatenate([v, v[:, [2, 0, 1]], v[:, [1, 2, 0]]])
    # Neighbours are 2 apart; any three that are neighbours of one another span a face.
    near = np.linalg.norm(v[:, None] - v, axis=2) < 2.1
    trios = [t for t in combinations(range(12), 3) if near[np.ix_(t, t)].all()]
    out = _outwards(v[np.array(trios)])
    for _ in range(divisions):
        middles = 0.5 * (out + np.roll(out, -1, axis=1))
        tops = [np.stack([out[:, i], middles[:, i], middles[:, i - 1]], axis=1) for i in range(3)]
        out = np.concatenate([*tops, middles])
    return np.asarray(out / np.linalg.norm(out, axis=2, keepdims=True))


def _outwards(triangles: Float) -> Float:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.sum(normals * triangles[:, 0], axis=1) < 0.0
    return np.where(inward[:, None, None], triangles[:, ::-1], triangles)
