"""Quantiles of the chi-squared distribution: where gates and consistency bands lie."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from vioframe.types import Float


def chi2_quantile(p: float, dof: ArrayLike) -> Float:
    """What a squared Mahalanobis distance of ``dof`` degrees of freedom stays below with probability ``p``.

    scipy.stats has it as well, and takes half a second to import.
    """
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(dof), p), np.float64)
