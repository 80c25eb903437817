"""Brightness that does not keep still: an exposure that drifts, and jumps as when a lamp is switched."""

import numpy as np

from vioframe.types import Float

_DRIFT_PERIOD_S = 7.0
_JUMP_EVERY_S = (1.5, 4.0)


def wandering_gain(t_s: Float, stops: float, rng: np.random.Generator) -> Float:
    """Gains (N,) at ascending times (N,) s, within ``stops`` powers of two of one: half of it drift, half jumps."""
    drift = np.sin(2.0 * np.pi * (t_s / _DRIFT_PERIOD_S + rng.random()))
    count = int(np.ceil((t_s[-1] - t_s[0]) / _JUMP_EVERY_S[0])) + 1
    jumps_s = t_s[0] + np.cumsum(rng.uniform(*_JUMP_EVERY_S, count))
    level = rng.uniform(-1.0, 1.0, count + 1)[np.searchsorted(jumps_s, t_s)]
    return np.asarray(2.0 ** (0.5 * stops * (drift + level)))
