"""Does the covariance tell the truth? Normalised estimation error squared. Maths: ``docs/derivations/alignment.md``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.quantiles import chi2_quantile
from vioframe.types import DP, DTHETA, Float, Int

_PARTS = {"orientation": DTHETA, "position": DP, "pose": slice(0, 6)}
_BAND = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class Nees:
    """e^T P^-1 e over time for one part of the state; its mean is ``dof`` where the covariance is honest.

    ``values`` (N,) at ``t_ns`` (N,). ``band`` is the two-sided 95 % interval of the chi-squared distribution with
    ``dof`` degrees of freedom, for a single instant; ``inside`` is the fraction of instants within it. Successive
    errors of one run are correlated, so the mean of one run is no test at a level: that takes a Monte Carlo over runs.
    """

    part: str
    dof: int
    t_ns: Int
    values: Float
    band: tuple[float, float]

    @property
    def mean(self) -> float:
        return float(self.values.mean())

    @property
    def inside(self) -> float:
        low, high = self.band
        return float(np.mean((self.values >= low) & (self.values <= high)))

    @property
    def held(self) -> float:
        """Fraction of instants at which the ellipsoid that should hold the truth in 95 % of them does."""
        return float(np.mean(self.values <= chi2_quantile(0.95, self.dof)))

    def to_dict(self) -> dict[str, object]:
        return {"dof": self.dof, "mean": self.mean, "inside_95": self.inside, "band_95": list(self.band)}


def nees(aligned: Trajectory, truth: Trajectory) -> tuple[Nees, ...]:
    """NEES of orientation, position and pose; ``aligned`` brings its covariance in the ground truth's world.

    Instants whose covariance is unknown (NaN) or singular, such as the very first where position and yaw are the gauge,
    tell nothing and are left out. Empty where no instant is left.
    """
    if aligned.cov_pose is None:
        return ()
    cov = 0.5 * (aligned.cov_pose + aligned.cov_pose.transpose(0, 2, 1))
    finite = np.flatnonzero(np.isfinite(cov).all(axis=(1, 2)))
    usable = finite[_well_conditioned(cov[finite])]
    if not usable.size:
        return ()
    # [dtheta dp] takes the estimate to the truth: R_true = R_est Exp(dtheta), p_true = p_est + dp.
    dtheta = so3.log(aligned.R_WB.transpose(0, 2, 1) @ truth.R_WB)
    error, cov = np.concatenate([dtheta, truth.p_WB - aligned.p_WB], axis=1)[usable], cov[usable]
    found = []
    for name, part in _PARTS.items():
        e = error[:, part]
        values = np.einsum("ni,ni->n", e, np.linalg.solve(cov[:, part, part], e[..., None])[..., 0])
        found.append(Nees(name, e.shape[1], aligned.t_ns[usable], values, band(e.shape[1])))
    return tuple(found)


def band(dof: int) -> tuple[float, float]:
    """The two-sided 95 % interval of the chi-squared distribution."""
    low, high = (float(chi2_quantile(p, dof)) for p in _BAND)
    return low, high


def _well_conditioned(cov: Float) -> NDArray[np.bool_]:
    """(N,) whether each matrix is positive definite beyond rounding, judged free of units by its correlations."""
    diagonal = np.einsum("nii->ni", cov)
    positive = (diagonal > 0.0).all(axis=1)
    sigma = np.sqrt(np.where(positive[:, None], diagonal, 1.0))
    smallest = np.linalg.eigvalsh(cov / sigma[:, :, None] / sigma[:, None, :])[:, 0]
    return np.asarray(positive & (smallest > 1e-12))
