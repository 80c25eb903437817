"""Checks a loop closer on a simulated flight of which only landmarks and pictures of noise are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from vioframe.estimation.soundness import defect_of_correction
from vioframe.interfaces import LoopCloser, LoopCloserFactory
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.testing.require import fail, freeze, require, same
from vioframe.types import Estimate, FrameSet, LoopClosure, MapCorrection, NavState, Status, Step

_DURATION_S = 26.0
_EVERY, _LOST = 4, range(50, 60)
_MOST_M, _MOST_RAD = 1e-6, 1e-6


def check_loop_closer(factory: LoopCloserFactory, **options: Any) -> None:
    """Check ``factory(calibration, **options)`` against :class:`vioframe.interfaces.LoopCloser`.

    That a trajectory without a place seen again comes out as it went in, one pose for each tracked frame, also where
    tracking was lost in between, and that nothing is corrected while flying; that pictures and arrays are left alone;
    that the same steps give the same result; and that a run without a single pose ends well.
    """
    sequence = simulated_sequence("figure_eight", duration_s=_DURATION_S, max_points=60)
    steps = _steps(sequence)
    closure, corrections = _run(factory(sequence.calibration, **options), steps)
    _check_closure(closure, steps)
    for correction in filter(None, corrections):
        require(same(correction, MapCorrection()), "pictures of noise were taken for a place seen again while flying")
    again, corrections_again = _run(factory(sequence.calibration, **options), steps)
    alike = same(replace(closure, stage_seconds={}), replace(again, stage_seconds={})) and all(
        same(*pair) for pair in zip(corrections, corrections_again, strict=True)
    )
    require(alike, "the same steps gave another result the second time")
    blank = [Step(s.frames, s.tracks, Estimate(Status.INITIALISING), {}) for s in steps[:20]]
    nothing, _ = _run(factory(sequence.calibration, **options), blank)
    require(
        nothing.trajectory is None and not nothing.loops, "there is a trajectory or a loop where nothing was tracked"
    )


def _steps(sequence: TrackSequence) -> list[Step]:
    """The true poses as an estimate, lost for a while; every picture is noise of its own, so that none is alike."""
    rng = np.random.default_rng(0)
    width, height = sequence.calibration.cameras[0].model.resolution
    truth = sequence.ground_truth
    steps = []
    for k, (_, tracks) in enumerate(sequence.packets[::_EVERY]):
        image = rng.integers(0, 256, (height, width), dtype=np.uint8)
        pose = truth.at(np.array([tracks.t_ns]), max_gap_s=1.0)
        zero = np.zeros(3)
        freeze(tracks)
        image.flags.writeable = False
        estimate = Estimate(Status.LOST)
        if k not in _LOST:
            state = NavState(tracks.t_ns, pose.R_WB[0], pose.p_WB[0], zero, zero, zero)
            ahead_C = np.column_stack([tracks.xy_normalised, np.ones(len(tracks.ids))]) * 4.0
            R_WC = state.R_WB @ sequence.calibration.cameras[0].R_BC
            p_WC = state.p_WB + state.R_WB @ sequence.calibration.cameras[0].p_BC
            estimate = Estimate(Status.TRACKING, state, tracks.ids, ahead_C @ R_WC.T + p_WC)
        steps.append(Step(FrameSet(tracks.t_ns, (image,)), tracks, estimate, {}))
    return steps


def _run(closer: LoopCloser, steps: list[Step]) -> tuple[LoopClosure, list[MapCorrection | None]]:
    try:
        corrections = [closer.add(step) for step in steps]
        closure = closer.finish()
    except Exception as error:
        fail(f"the loop closer raised {error!r}")
    for defect in map(defect_of_correction, corrections):
        require(defect is None, f"add(): {defect}")
    require(isinstance(closure, LoopClosure), f"finish() returned a {type(closure).__name__}, not a LoopClosure")
    return closure, corrections


def _check_closure(closure: LoopClosure, steps: list[Step]) -> None:
    states = [s.estimate.state for s in steps if s.estimate.state is not None]
    trajectory = closure.trajectory
    if trajectory is None:
        fail("there is no trajectory although frames were tracked")
    t_ns = np.array([state.t_ns for state in states])
    require(np.array_equal(trajectory.t_ns, t_ns), "the trajectory must have one pose for each tracked frame")
    require(np.isin(closure.keyframe_t_ns, t_ns).all(), "a keyframe is not among the tracked frames")
    require(not any(loop.accepted for loop in closure.loops), "pictures of noise were taken for a place seen again")
    moved = np.abs(trajectory.p_WB - np.array([state.p_WB for state in states])).max()
    turned = np.abs(trajectory.R_WB - np.array([state.R_WB for state in states])).max()
    require(
        moved < _MOST_M and turned < _MOST_RAD, f"without a loop the path moved by {moved:.2g} m, turned {turned:.2g}"
    )
    require(all(seconds >= 0.0 for seconds in closure.stage_seconds.values()), "negative stage_seconds")
