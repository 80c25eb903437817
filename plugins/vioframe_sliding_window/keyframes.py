"""Which frames stay: those that see the scene from somewhere else than the last that stayed."""

from __future__ import annotations

import numpy as np

from vioframe.types import Float
from vioframe_sliding_window.tracks import TrackTable


def parallax(tracks: TrackTable, before: int, now: int, R_CbCn: Float) -> tuple[int, float]:
    """Number of tracks common to two frames, and their mean motion on the z = 1 plane with the rotation taken out.

    ``R_CbCn`` (3, 3) takes the later camera's axes to the earlier one's.
    """
    common = tracks.seen[:, before] & tracks.seen[:, now]
    if not common.any():
        return 0, 0.0
    rays = np.column_stack([tracks.xy[common, now], np.ones(common.sum())]) @ R_CbCn.T
    ahead = rays[:, 2] > 0.0
    moved = rays[ahead, :2] / rays[ahead, 2:] - tracks.xy[common, before][ahead]
    return int(common.sum()), float(np.linalg.norm(moved, axis=1).mean()) if ahead.any() else np.inf
