"""Quantiles of the chi-squared distribution: where gates and consistency bands lie."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from vioframe.types import Float


def chi2_quantile(p: float, dof: ArrayLike) -> Float:
    """What a squared Mahalanobis distance of ``dof`` degrees of freedom stays below with probability ``p``.

    scipy.stats has it as well, and takes half a second to import; what this imports takes a tenth, when first asked.
    """
    from scipy.special import gammaincinv

    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(dof), p), np.float64)


@cache
def gate(p: float, dof: int) -> float:
    """That of one number of degrees of freedom."""
    return float(chi2_quantile(p, dof))
