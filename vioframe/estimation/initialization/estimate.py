"""What an initialisation comes to: an estimate, or a refusal with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vioframe.types import Float, Int, NavState


@dataclass(frozen=True, slots=True)
class InitialEstimate:
    """Where an estimator begins, in a world with z up whose origin and yaw zero are those of the first state.

    ``states`` are the window's frames, oldest first. The last is the newest frame and has ``cov`` (15, 15), with
    position and yaw, which nothing measures, pinned at that frame. ``landmark_ids`` (L,) and ``p_WF`` (L, 3) m are the
    dynamic method's landmarks.
    """

    method: Literal["static", "dynamic"]
    states: tuple[NavState, ...]
    landmark_ids: Int = field(default_factory=lambda: np.empty(0, np.int64))
    p_WF: Float = field(default_factory=lambda: np.empty((0, 3)))


class RefusalError(Exception):
    """An attempt came to nothing; the message says why in one line. Never leaves the package."""
