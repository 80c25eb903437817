"""The Allan deviation: how far averages of a sensor's readings stray from one to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vioframe.types import Float


def allan_deviation(readings: Float, rate_hz: float, tau_s: ArrayLike) -> Float:
    """The overlapping Allan deviation (M, ...) of ``readings`` (N, ...) over averages of ``tau_s`` (M,) s.

    White noise of density ``s`` shows as ``s / sqrt(tau)``, a bias of diffusion ``w`` as ``w sqrt(tau / 3)`` (IEEE Std
    952-1997, annex C: angle random walk and rate random walk). Each tau is rounded to whole readings. Raises
    :class:`ValueError` for one below a reading or above half of the recording.
    """
    total = np.concatenate([np.zeros((1, *readings.shape[1:])), np.cumsum(readings, axis=0)])
    out = []
    for tau in np.atleast_1d(tau_s):
        n = round(float(tau) * rate_hz)
        if not 1 <= n <= len(readings) // 2:
            raise ValueError(f"tau {tau:g} s must span a reading and at most half of the {len(readings)} there are")
        change = (total[2 * n :] - 2.0 * total[n:-n] + total[: -2 * n]) / n
        out.append(np.sqrt(0.5 * (change**2).mean(axis=0)))
    return np.array(out)
