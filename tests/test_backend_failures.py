"""What a back-end does when sight or readings fail in mid-flight, whichever it is: it goes on within seconds.

Simulated landmarks on a flight known exactly. Where an estimate is lost a new stretch begins; each stretch is held
against the truth by itself.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from vioframe.bench import BackendRun, run_backend
from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.evaluation import evaluate
from vioframe.parts import registry
from vioframe.simulation import Packet, TrackSequence, simulated_sequence
from vioframe.simulation.tracks import TrackOptions, TrackSimulator
from vioframe.types import NS_PER_S, FrameTracks, ImuSegment, Status

BACKENDS = ("msckf", "sliding_window", "loose_ekf")
FAILS_S, DURATION_S = 7.0, 18.0
OTHERS = 1_000_000
"""Added to ids after a failure: what is tracked then was never seen before."""


@cache
def flight() -> TrackSequence:
    return simulated_sequence("figure_eight", duration_s=DURATION_S, seed=1)


def seconds(sequence: TrackSequence, tracks: FrameTracks) -> float:
    return (tracks.t_ns - sequence.packets[0][1].t_ns) / NS_PER_S


def renamed(tracks: FrameTracks) -> FrameTracks:
    return replace(tracks, ids=tracks.ids + OTHERS)


def blind(sequence):
    """Black images for two seconds."""
    for imu, tracks in sequence.packets:
        t_s = seconds(sequence, tracks)
        if FAILS_S <= t_s < FAILS_S + 2.0:
            yield imu, FrameTracks.none(tracks.t_ns)
        else:
            yield imu, tracks if t_s < FAILS_S else renamed(tracks)


def without_readings(sequence):
    """No reading and no image for a second; the next image finds nothing of what was tracked."""
    lost = []
    for imu, tracks in sequence.packets:
        t_s = seconds(sequence, tracks)
        if FAILS_S <= t_s < FAILS_S + 1.0:
            lost.append(imu)
            continue
        if lost:
            whole = join_segments([*lost, imu])
            ends = [0, -1]
            imu = ImuSegment(whole.t_ns[ends], whole.gyro_B[ends], whole.accel_B[ends], whole.duration_s)
            lost = []
        yield imu, tracks if t_s < FAILS_S else renamed(tracks)


def kidnapped(sequence):
    """Images of another place from one frame to the next, of which the readings know nothing."""
    for imu, tracks in sequence.packets:
        yield imu, tracks if seconds(sequence, tracks) < FAILS_S else renamed(tracks)


def kidnapped_within_sight(sequence):
    """Three metres sideways at once, and what stays in view is recognised."""
    simulator = TrackSimulator(sequence.calibration, TrackOptions(depth_m=(4.0, 10.0)), np.random.default_rng(3))
    truth = sequence.ground_truth
    before = np.array([seconds(sequence, tracks) < FAILS_S for _, tracks in sequence.packets])
    aside = 3.0 * truth.R_WB[before.sum()][:, 1]
    for (imu, tracks), R, p, unmoved in zip(sequence.packets, truth.R_WB, truth.p_WB, before, strict=True):
        yield imu, simulator.observe(tracks.t_ns, R, p if unmoved else p + aside)


def not_finite(sequence):
    """Points that could not be undistorted, half a second long."""
    for imu, tracks in sequence.packets:
        if FAILS_S <= seconds(sequence, tracks) < FAILS_S + 0.5:
            xy_normalised = tracks.xy_normalised.copy()
            xy_normalised[::3] = np.nan
            tracks = replace(tracks, xy_normalised=xy_normalised)
        yield imu, tracks


def torn(sequence):
    """Most observations of half a second anywhere but where they belong."""
    rng = np.random.default_rng(5)
    for imu, tracks in sequence.packets:
        if FAILS_S <= seconds(sequence, tracks) < FAILS_S + 0.5:
            xy = tracks.xy.copy()
            wrong = rng.random(len(xy)) < 0.7
            xy[wrong] = rng.uniform(10.0, 470.0, (wrong.sum(), 2))
            tracks = replace(tracks, xy=xy, xy_normalised=sequence.calibration.cameras[0].model.undistort(xy))
        yield imu, tracks


@cache
def flown(failure: Callable[[TrackSequence], Iterator[Packet]], backend: str) -> tuple[TrackSequence, BackendRun]:
    """What a back-end makes of the flight with a failure, and that flight."""
    sequence = flight()
    packets = tuple(failure(sequence))
    truth = sequence.ground_truth
    kept = np.isin(truth.t_ns, [tracks.t_ns for _, tracks in packets])
    disturbed = replace(
        sequence,
        packets=packets,
        ground_truth=replace(truth, t_ns=truth.t_ns[kept], R_WB=truth.R_WB[kept], p_WB=truth.p_WB[kept]),
    )
    with threadpool_limits(1):
        return disturbed, run_backend(disturbed, registry.load().create_backend(backend))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("failure", "good_again_s"),
    [
        (blind, 2.0),
        (without_readings, 1.0),
        (kidnapped, 0.0),
        (kidnapped_within_sight, 0.0),
        (not_finite, 0.5),
        (torn, 0.5),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_it_goes_on_within_seconds(backend, failure, good_again_s):
    disturbed, run = flown(failure, backend)
    t_ns = np.array([tracks.t_ns for _, tracks in disturbed.packets])
    for state in run.states:
        values = (state.R_WB, state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B, state.cov)
        assert all(np.isfinite(value).all() for value in values)
    tracking = np.array([estimate.status is Status.TRACKING for estimate in run.estimates])
    good_ns = t_ns[0] + (FAILS_S + good_again_s) * NS_PER_S
    assert tracking[t_ns > good_ns + 5 * NS_PER_S].all()
    lost = [estimate for estimate in run.estimates if estimate.status is Status.LOST]
    assert len(lost) <= 2
    for estimate in lost:
        assert any(event.startswith("lost: ") for event in estimate.events)
    for stretch in run.stretches:
        if len(stretch.t_ns) > 40:
            assert evaluate(stretch, disturbed.ground_truth).ate_m.rmse < 0.15


def test_the_sliding_window_begins_anew_where_all_it_saw_changed_at_once():
    _, run = flown(kidnapped, "sliding_window")
    events = [event for estimate in run.estimates for event in estimate.events if event.startswith("lost")]
    assert events == ["lost: everything in sight changed at once, though the body hardly turned"]
    assert run.resets == 1
    assert len(run.stretches) == 2
