"""Boxes that fly around: a motion in the image that is not the camera's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.simulation.world import MeshBuilder
from vioframe.types import Float, Int, Mesh

_SIZE_M = (0.3, 1.1)
_SWING_M = (0.4, 1.6)
_AROUND_M = np.array([2.2, 2.2, 1.2])  # with the swing still within the walls of a hall
_PERIOD_S = (3.0, 9.0)
_CLEARANCE_M = 1.2
_TRIES = 400


@dataclass(frozen=True)
class Movers:
    """M boxes swinging about ``centre_W`` (M, 3) m by ``swing_m`` (M, 3), in ``period_s`` (M, 3) from ``phase`` rad.

    ``mesh`` holds each about its own origin and ``owner`` (T,) the box that a triangle belongs to.
    """

    mesh: Mesh
    owner: Int
    centre_W: Float
    swing_m: Float
    period_s: Float
    phase: Float

    def at(self, t_s: Float) -> Float:
        """Where they are at times (N,) s: (N, M, 3) m."""
        angle = 2.0 * np.pi * np.asarray(t_s)[:, None, None] / self.period_s + self.phase
        return np.asarray(self.centre_W + self.swing_m * np.sin(angle))

    def corners(self, p_W: Float) -> Float:
        """(T, 3, 3) m with the boxes at ``p_W`` (M, 3)."""
        return np.asarray(self.mesh.corners + p_W[self.owner][:, None, :])


def draw_movers(count: int, t_s: Float, p_WC: Float, textures: int, rng: np.random.Generator) -> Movers | None:
    """``count`` boxes around the path ``p_WC`` (N, 3) m, flown at ``t_s`` (N,), that never come near it.

    Fewer, or None, where the path leaves no room for them.
    """
    low, high = p_WC.min(axis=0) - _AROUND_M, p_WC.max(axis=0) + _AROUND_M
    builder = MeshBuilder()
    owner: list[int] = []
    swings: list[tuple[Float, Float, Float, Float]] = []
    for _ in range(_TRIES):
        if len(swings) == count:
            break
        size = rng.uniform(*_SIZE_M, 3)
        swing = (
            rng.uniform(low, high),
            rng.uniform(*_SWING_M, 3) * [1.0, 1.0, 0.3],
            rng.uniform(*_PERIOD_S, 3),
            rng.uniform(0.0, 2.0 * np.pi, 3),
        )
        centre, amplitude, period, phase = swing
        path = centre + amplitude * np.sin(2.0 * np.pi * t_s[:, None] / period + phase)
        if np.linalg.norm(path - p_WC, axis=1).min() < _CLEARANCE_M + 0.5 * float(np.linalg.norm(size)):
            continue
        builder.box(-0.5 * size, 0.5 * size, rng.integers(textures, size=6), float(size.max()), rng.random(2))
        owner += 12 * [len(swings)]  # two triangles a face
        swings.append(swing)
    if not swings:
        return None
    return Movers(builder.build(), np.array(owner), *(np.array(part) for part in zip(*swings, strict=True)))
