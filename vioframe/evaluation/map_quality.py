"""How far a run's landmarks lie from the surfaces of the world that they were seen on.

Only a simulated world is known well enough for this. Every landmark of ``map.ply`` counts, the outliers too: a metric
that cleans first hides what it should show. Median and quantiles are not led by a few far ones; RMSE is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.geometry.meshes import distances
from vioframe.types import Float

WITHIN_M = (0.05, 0.10, 0.20)


@dataclass(frozen=True)
class MapQuality:
    """Unsigned distances of ``landmarks`` from the mesh ``world``; ``within`` is a fraction by distance in m."""

    world: Path
    landmarks: int
    median_m: float
    rmse_m: float
    q90_m: float
    within: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, p_GF: Float, corners: Float, world: Path) -> MapQuality:
        """Of landmarks (M, 3) m, M >= 1, in the world of the triangles ``corners`` (T, 3, 3) m."""
        distance = distances(p_GF, corners)
        return cls(
            world=world,
            landmarks=len(distance),
            median_m=float(np.median(distance)),
            rmse_m=float(np.sqrt(np.mean(distance**2))),
            q90_m=float(np.quantile(distance, 0.9)),
            within=tuple((limit, float(np.mean(distance <= limit))) for limit in WITHIN_M),
        )

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "world": str(self.world),
            "landmarks": self.landmarks,
            "median_m": self.median_m,
            "rmse_m": self.rmse_m,
            "q90_m": self.q90_m,
            "within": {f"{100 * limit:g}cm": part for limit, part in self.within},
        }
