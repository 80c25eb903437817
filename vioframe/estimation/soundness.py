"""What any back-end's estimate must be: checked at every frame of a run, and by the conformance kit."""

from __future__ import annotations

import numpy as np

from vioframe.types import Estimate, NavState, Status

_ORTHONORMAL = 1e-9
_RELATIVE_SYMMETRY = 1e-9
_SHAPES = {"R_WB": (3, 3), "p_WB": (3,), "v_WB": (3,), "bias_gyro_B": (3,), "bias_accel_B": (3,)}


def defect_of(estimate: object, t_ns: int) -> str | None:
    """What is wrong with the estimate of the frame at ``t_ns``, in one line; None where nothing is."""
    if not isinstance(estimate, Estimate):
        return f"it returned a {type(estimate).__name__}, not an Estimate"
    if not isinstance(estimate.status, Status):
        return f"its status is {estimate.status!r}, not a Status"
    m = len(estimate.landmark_ids)
    if estimate.p_WF.shape != (m, 3):
        return f"p_WF has the shape {estimate.p_WF.shape} for {m} landmarks"
    if len(set(estimate.landmark_ids.tolist())) != m:
        return "landmark_ids repeat"
    if not np.isfinite(estimate.p_WF).all():
        return "p_WF is not finite"
    if any(seconds < 0.0 for seconds in estimate.stage_seconds.values()):
        return "stage_seconds are negative"
    if estimate.state is None:
        return "it tracks without a state" if estimate.status is Status.TRACKING else None
    return _defect_of_state(estimate.state, t_ns)


def _defect_of_state(state: NavState, t_ns: int) -> str | None:
    if state.t_ns != t_ns:
        return f"its state is of {state.t_ns} ns, the frame of {t_ns} ns"
    for name, shape in _SHAPES.items():
        array = getattr(state, name)
        if array.shape != shape:
            return f"{name} has the shape {array.shape}, expected {shape}"
        if not np.isfinite(array).all():
            return f"{name} is not finite"
    R_WB = state.R_WB
    if np.abs(R_WB @ R_WB.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R_WB) < 0.0:
        return "R_WB is not a rotation"
    if state.cov is None:
        return None
    if state.cov.shape != (15, 15):
        return f"cov has the shape {state.cov.shape}, expected (15, 15)"
    if not np.isfinite(state.cov).all():
        return "cov is not finite"
    tolerance = _RELATIVE_SYMMETRY * np.abs(state.cov).max()
    if np.abs(state.cov - state.cov.T).max() > tolerance:
        return "cov is not symmetric"
    smallest = np.linalg.eigvalsh(state.cov)[0]
    if smallest < -tolerance:
        return f"cov has the eigenvalue {smallest:.2e}"
    return None
