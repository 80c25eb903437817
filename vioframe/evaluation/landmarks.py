"""The landmark cloud of a run: reading it, telling landmarks that stand alone from those that belong, and its quality.

A run folder keeps every landmark that its back-end spoke of. Cleaning is the reader's choice, made here. What is
measured against the surfaces of a simulated world, the only one known well enough, are all of them, the outliers too: a
metric that cleans first hides what it should show. Median and quantiles are not led by a few far ones; RMSE is.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import RunError
from vioframe.evaluation import Alignment
from vioframe.geometry.meshes import distances
from vioframe.types import Float, Int

WITHIN_CM = (5, 10, 20)


@dataclass(frozen=True, eq=False)
class Landmarks:
    """``ids`` (M,) ascending and ``p_WF`` (M, 3) m."""

    ids: Int
    p_WF: Float

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, which: NDArray[np.bool_]) -> Landmarks:
        return Landmarks(self.ids[which], self.p_WF[which])

    def moved(self, alignment: Alignment) -> Landmarks:
        """The same landmarks seen in the ground truth's world."""
        return Landmarks(self.ids, alignment.points(self.p_WF))


def read_landmarks(path: Path) -> Landmarks:
    """The ``map.ply`` of a run folder; raises :class:`RunError` where it is damaged."""
    header, _, body = path.read_text(encoding="utf-8", errors="replace").partition("end_header\n")
    counts = re.findall(r"^element vertex (\d+)$", header, re.MULTILINE)
    columns = re.findall(r"^property \w+ (\w+)$", header, re.MULTILINE)
    try:
        if len(counts) != 1 or columns != ["x", "y", "z", "id"] or "format ascii" not in header:
            raise ValueError("not the header that vioframe writes")
        rows = np.loadtxt(StringIO(body), ndmin=2).reshape(-1, 4) if body.strip() else np.empty((0, 4))
        if len(rows) != int(counts[0]):
            raise ValueError(f"{len(rows)} of {counts[0]} landmarks")
        if not np.isfinite(rows).all():
            raise ValueError("not finite")
    except ValueError as error:
        raise RunError(f"{path} is damaged ({' '.join(str(error).split())}); delete it to go on without it") from None
    return Landmarks(rows[:, 3].astype(np.int64), rows[:, :3])


def belonging(p_WF: Float, neighbours: int = 20, std_ratio: float = 2.0) -> NDArray[np.bool_]:
    """(M,) whether each landmark (M, 3) lies among others: statistical outlier removal.

    A landmark stands alone where its mean distance to its nearest ``neighbours`` is above the mean of that over all
    landmarks by more than ``std_ratio`` standard deviations (Rusu et al. 2008, section 3). As in Open3D's
    ``remove_statistical_outlier``, a landmark counts as a neighbour of itself.
    """
    from scipy.spatial import KDTree

    if len(p_WF) < 2:
        return np.ones(len(p_WF), dtype=bool)
    k = min(neighbours, len(p_WF))
    distance = np.asarray(KDTree(p_WF).query(p_WF, k=k)[0]).reshape(len(p_WF), k).mean(axis=1)
    return np.asarray(distance <= distance.mean() + std_ratio * distance.std(ddof=1))


@dataclass(frozen=True)
class MapQuality:
    """Unsigned distances of ``landmarks`` from the mesh ``world``; ``within`` is a part by distance, such as "5cm"."""

    world: str
    landmarks: int
    median_m: float
    rmse_m: float
    q90_m: float
    within: Mapping[str, float]

    @classmethod
    def of(cls, p_GF: Float, corners: Float, world: Path) -> MapQuality:
        """Of landmarks (M, 3) m, M >= 1, in the world of the triangles ``corners`` (T, 3, 3) m."""
        distance = distances(p_GF, corners)
        return cls(
            world=str(world),
            landmarks=len(distance),
            median_m=float(np.median(distance)),
            rmse_m=float(np.sqrt(np.mean(distance**2))),
            q90_m=float(np.quantile(distance, 0.9)),
            within={f"{limit}cm": float(np.mean(distance <= 0.01 * limit)) for limit in WITHIN_CM},
        )

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return asdict(self)
