"""What a back-end's estimate and a loop closer's correction must be: checked at every frame, and by the kit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vioframe.types import CalibrationEstimate, Estimate, Float, MapCorrection, NavState, Status

_ORTHONORMAL = 1e-9
_RELATIVE_SYMMETRY = 1e-9
_SHAPES = {"R_WB": (3, 3), "p_WB": (3,), "v_WB": (3,), "bias_gyro_B": (3,), "bias_accel_B": (3,)}


def defect_of(estimate: object, t_ns: int) -> str | None:
    """What is wrong with the estimate of the frame at ``t_ns``, in one line; None where nothing is."""
    if not isinstance(estimate, Estimate):
        return f"it returned a {type(estimate).__name__}, not an Estimate"
    if not isinstance(estimate.status, Status):
        return f"its status is {estimate.status!r}, not a Status"
    ids = estimate.landmark_ids
    if not isinstance(ids, np.ndarray) or ids.ndim != 1 or ids.dtype.kind not in "iu":
        return "landmark_ids are not an array (M,) of integers"
    if len(set(ids.tolist())) != len(ids):
        return "landmark_ids repeat"
    if (defect := _defect_of_array("p_WF", estimate.p_WF, (len(ids), 3))) is not None:
        return defect
    if not isinstance(estimate.events, tuple) or not all(isinstance(event, str) for event in estimate.events):
        return "its events are not a tuple of texts"
    spent = estimate.stage_seconds
    if not isinstance(spent, Mapping) or not all(isinstance(seconds, float | int) for seconds in spent.values()):
        return "stage_seconds are not seconds by stage"
    if any(seconds < 0.0 for seconds in spent.values()):
        return "stage_seconds are negative"
    if not isinstance(estimate.calibration, CalibrationEstimate | None):
        return f"its calibration is a {type(estimate.calibration).__name__}, not a CalibrationEstimate"
    if estimate.state is None:
        return "it tracks without a state" if estimate.status is Status.TRACKING else None
    return _defect_of_state(estimate.state, t_ns)


def defect_of_correction(correction: object) -> str | None:
    """What is wrong with what a loop closer returned for a frame, in one line; None where nothing is."""
    if correction is None:
        return None
    if not isinstance(correction, MapCorrection):
        return f"it returned a {type(correction).__name__}, not a MapCorrection"
    for name, shape in (("R_MW", (3, 3)), ("p_MW", (3,))):
        if (defect := _defect_of_array(name, getattr(correction, name), shape)) is not None:
            return defect
    if not _is_rotation(correction.R_MW) or abs(correction.R_MW[2, 2] - 1.0) > _ORTHONORMAL:
        return "R_MW is not a rotation about z"
    return None


def _is_rotation(R: Float) -> bool:
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= _ORTHONORMAL and np.linalg.det(R) > 0.0)


def _defect_of_state(state: object, t_ns: int) -> str | None:
    if not isinstance(state, NavState):
        return f"its state is a {type(state).__name__}, not a NavState"
    if state.t_ns != t_ns:
        return f"its state is of {state.t_ns} ns, the frame of {t_ns} ns"
    for name, shape in _SHAPES.items():
        if (defect := _defect_of_array(name, getattr(state, name), shape)) is not None:
            return defect
    if not _is_rotation(state.R_WB):
        return "R_WB is not a rotation"
    return None if state.cov is None else _defect_of_covariance(state.cov)


def _defect_of_covariance(cov: object) -> str | None:
    if (defect := _defect_of_array("cov", cov, (15, 15))) is not None:
        return defect
    assert isinstance(cov, np.ndarray)
    tolerance = _RELATIVE_SYMMETRY * np.abs(cov).max()
    if np.abs(cov - cov.T).max() > tolerance:
        return "cov is not symmetric"
    smallest = np.linalg.eigvalsh(cov)[0]
    if smallest < -tolerance:
        return f"cov has the eigenvalue {smallest:.2e}"
    return None


def _defect_of_array(name: str, array: object, shape: tuple[int, ...]) -> str | None:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        return f"{name} is no array of numbers"
    if array.shape != shape:
        return f"{name} has the shape {array.shape}, expected {shape}"
    return None if np.isfinite(array).all() else f"{name} is not finite"
