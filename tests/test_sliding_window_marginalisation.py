"""Letting states go loses nothing and makes nothing up: the batch of all, and the unobservable directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, STEREO, drawn_start, since
from sliding_window_helpers import flown_window, moved, natural, only, standing

from vioframe.bench import run_backend
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.problem import (
    STATE_SIZE,
    Prior,
    Problem,
    Variables,
    marginalise_oldest,
    schur,
    symmetric,
)
from vioframe.simulation import simulated_sequence
from vioframe.types import DP, DTHETA, DV, Float, NavState
from vioframe_sliding_window import window as window_module
from vioframe_sliding_window.backend import SlidingWindow
from vioframe_sliding_window.options import SlidingWindowOptions

UP = np.array([0.0, 0.0, 1.0])
FLIGHTS = ("figure_eight", "aggressive", "stop_and_go")


@pytest.mark.parametrize("seed", range(5))
def test_schur_complement_is_the_marginal(seed):
    """The covariance of what stays is that which it had, and so is the solution; units differ by many orders."""
    rng = np.random.default_rng(seed)
    n, count = 20, int(rng.integers(1, 16))
    unit = 10.0 ** rng.uniform(-3.0, 3.0, n)
    A = rng.normal(size=(2 * n, n))
    H, b = A.T @ A * np.outer(unit, unit), A.T @ rng.normal(size=2 * n) * unit
    S, g = schur(H, b, count)
    cov = np.linalg.inv(A.T @ A) / np.outer(unit, unit)
    u = unit[count:]
    marginal = cov[count:, count:] * np.outer(u, u)
    np.testing.assert_allclose(np.linalg.inv(S / np.outer(u, u)), marginal, rtol=1e-9, atol=1e-9 * marginal.max())
    np.testing.assert_allclose(np.linalg.solve(S / np.outer(u, u), g / u), (cov @ b)[count:] * u, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(S, S.T)


@pytest.mark.parametrize("seed", range(5))
def test_schur_complement_where_directions_are_unknown(seed):
    """Whatever the others are, it is the least that the cost can be over those that go, some of which are free."""
    rng = np.random.default_rng(seed)
    n, count, unknown = 20, 12, 4
    # Rows of which those that go are seen only through `count - unknown` combinations.
    A = rng.normal(size=(2 * n, n))
    A[:, :count] = A[:, :count] @ rng.normal(size=(count, count - unknown)) @ rng.normal(size=(count - unknown, count))
    r = rng.normal(size=2 * n)
    S, g = schur(A.T @ A, A.T @ r, count)
    assert np.linalg.matrix_rank(A[:, :count].T @ A[:, :count]) == count - unknown

    def least(d: Float) -> float:
        residual = r + A[:, count:] @ d
        best = np.linalg.lstsq(A[:, :count], -residual, rcond=None)[0]
        return float(0.5 * ((residual + A[:, :count] @ best) ** 2).sum())

    for d in rng.normal(size=(5, n - count)):
        assert 0.5 * d @ S @ d + g @ d == pytest.approx(least(d) - least(np.zeros(n - count)), rel=1e-9)


def test_nothing_known_of_what_goes_changes_nothing():
    H, b = np.zeros((6, 6)), np.zeros(6)
    H[3:, 3:], b[3:] = np.diag([1.0, 2.0, 3.0]), [4.0, 5.0, 6.0]
    S, g = schur(H, b, 3)
    np.testing.assert_array_equal(S, H[3:, 3:])
    np.testing.assert_array_equal(g, b[3:])


SPAN = 5
"""Frames of the windows below; no track is longer."""


def short_tracks(frames: int, noise_px: float = 2.0) -> tuple[Problem, Variables]:
    """A window whose tracks end with the last frame that is in the window together with their first."""
    problem, x = flown_window(frames, 60, noise_px=noise_px)
    s = problem.sightings
    seen = s.seen & (np.arange(frames) < s.seen.argmax(axis=1)[:, None] + SPAN)
    enough = seen.sum(axis=1) >= 2
    rows = np.flatnonzero(enough)[np.argsort(seen[enough].argmax(axis=1), kind="stable")]
    problem = replace(problem, sightings=only(s._replace(seen=seen), rows))
    return problem, replace(x, landmarks=x.landmarks[rows])


def part(problem: Problem, prior: Prior, frames: slice, readings: slice, rows: np.ndarray) -> Problem:
    """Some of the factors, over some of the states, with another prior on these."""
    s = only(problem.sightings, rows)
    lens = s.lens._replace(px=s.lens.px[:, frames], at=s.lens.at[frames])
    s = s._replace(seen=s.seen[:, frames], share=s.share[:, frames], xy=s.xy[:, frames], lens=lens)
    s = s._replace(velocity=s.velocity[:, frames], to_px=s.to_px[:, frames])
    f = problem.readings
    some = ImuFactors(*(values[readings] for values in f))
    still = {k - frames.start: still for k, still in problem.still.items() if frames.start <= k < frames.stop}
    return replace(problem, prior=prior, readings=some, sightings=s, still=still)


def slid(problem: Problem, at: list[Variables]) -> tuple[Problem, Variables]:
    """The window of ``SPAN`` frames pushed along ``problem``: the k-th state goes at the values ``at[k]``."""
    frames, hosts = len(at[0].states), problem.sightings.seen.argmax(axis=1)
    prior = problem.prior
    for _ in range(frames - SPAN):
        prior = prior.without_newest()
    for k, x in enumerate(at[:-1]):
        window, rows = slice(k, k + SPAN), hosts == k
        here = Variables(x.states[window], x.cameras, x.landmarks[rows])
        oldest = part(problem, prior, window, slice(k, k + 1), rows)
        oldest = replace(oldest, still={i: still for i, still in oldest.still.items() if i == 0})
        prior = marginalise_oldest(oldest, here).with_state(x.states[k + 1 : k + 1 + SPAN])
    gone, x, rows = len(at) - 1, at[-1], hosts >= len(at) - 1
    left = Variables(x.states[gone:], x.cameras, x.landmarks[rows])
    return part(problem, prior, slice(gone, frames), slice(gone, frames - 1), rows), left


def solution(problem: Problem, x: Variables) -> tuple[Float, Float, Float]:
    """Step (n,), covariance (n, n) in natural units, and step of the landmarks (L, 3), of the linearised problem."""
    unit, normal = natural(x), problem.linearise(x)
    S, g, eliminated = normal.reduced(0.0)
    cov = np.linalg.inv(symmetric(S) * np.outer(unit, unit))
    step = -cov @ (g * unit)
    return step, cov, normal.landmark_step(step * unit, eliminated)


def assert_as_the_batch(problem: Problem, at: list[Variables], rtol: float) -> None:
    step, cov, landmark_step = solution(*slid(problem, at))
    batch_step, batch_cov, batch_landmark_step = solution(problem, at[-1])
    n = len(step)
    assert np.abs(batch_step[-n:]).max() > 0.1
    np.testing.assert_allclose(step, batch_step[-n:], rtol=0.0, atol=rtol * np.abs(batch_step[-n:]).max())
    np.testing.assert_allclose(cov, batch_cov[-n:, -n:], rtol=0.0, atol=rtol * np.abs(batch_cov[-n:, -n:]).max())
    landmark_scale = np.abs(batch_landmark_step).max()
    np.testing.assert_allclose(
        landmark_step, batch_landmark_step[-len(landmark_step) :], rtol=0.0, atol=rtol * landmark_scale
    )


@pytest.mark.parametrize("first_estimates", [True, False])
@pytest.mark.parametrize("frames", [SPAN + 1, SPAN + 3])
def test_sliding_along_is_the_batch_of_all(frames, first_estimates):
    """Estimate and covariance of states, calibration and landmarks, robust weights and standstill among it."""
    problem, x = short_tracks(frames)
    problem, x = replace(standing(problem, 0), first_estimates=first_estimates), moved(x, np.random.default_rng(0), 0.1)
    assert_as_the_batch(problem, [x] * (frames - SPAN + 1), 1e-7)


def test_moving_on_between_is_the_batch_of_all_to_second_order():
    """Where all agree but the present estimate, whose errors a linear problem would take back in one step.

    Of a move ten times smaller the difference is a hundred times smaller.
    """
    problem, exact = short_tracks(SPAN + 3, noise_px=0.0)
    differences = []
    for size in (1e-2, 1e-3):
        rng, at = np.random.default_rng(1), [exact]
        for _ in range(3):
            at.append(moved(at[-1], rng, size))
        step, (batch, *_) = solution(*slid(problem, at))[0], solution(problem, at[-1])
        batch = batch[-len(step) :]
        assert np.abs(batch).max() > size
        differences.append(np.abs(step - batch).max() / size)
    assert differences[0] < 0.05
    assert differences[1] < 0.15 * differences[0]


def test_states_that_factors_touched_are_frozen_where_they_were():
    problem, first = flown_window(SPAN)
    s = problem.sightings
    rows = (s.seen.argmax(axis=1) == 0) & ~s.seen[:, 3]
    oldest = part(problem, problem.prior, slice(0, SPAN), slice(0, 1), rows)
    x = moved(replace(first, landmarks=first.landmarks[rows]), np.random.default_rng(0), 0.1)
    prior = marginalise_oldest(oldest, x)
    # The second state was known to the prior before, the third and fifth are seen now, of the fourth nobody speaks.
    assert prior.frozen.tolist() == [True, True, False, True]
    np.testing.assert_array_equal(prior.states.p_WB[0], first.states.p_WB[1])
    np.testing.assert_array_equal(prior.states.p_WB[[1, 3]], x.states.p_WB[[2, 4]])
    assert not prior.H[30:45].any()


def unobservable(prior: Prior) -> Float:
    """(n, 4) at the first estimates: the world moved along its axes, and turned about gravity."""
    states = prior.states
    N = np.zeros((len(states), STATE_SIZE, 4))
    N[:, DP, :3] = np.eye(3)
    N[:, DTHETA, 3] = states.R_WB.swapaxes(-1, -2) @ UP
    N[:, DP, 3], N[:, DV, 3] = np.cross(UP, states.p_WB), np.cross(UP, states.v_WB)
    N[~prior.frozen] = 0.0
    out = np.zeros((len(prior.b), 4))
    out[: STATE_SIZE * len(states)] = N.reshape(-1, 4)
    return out


def start_in_the_dark(true: NavState, seed: int, position_m: float, yaw_rad: float) -> NavState:
    """The true state, off by what its covariance says: all turns with yaw, as after an initialisation.

    Were a velocity independent of yaw, it would be a legitimate compass.
    """
    up_B = true.R_WB.T @ UP
    cov = np.diag(np.repeat([0.005, 0.001, 0.05, 0.005, 0.05], 3) ** 2)
    cov[DTHETA, DTHETA] -= 0.005**2 * np.outer(up_B, up_B)
    N = np.zeros((15, 4))
    N[DP, :3], N[DTHETA, 3] = np.eye(3), up_B
    N[DP, 3], N[DV, 3] = np.cross(UP, true.p_WB), np.cross(UP, true.v_WB)
    d = np.random.default_rng(seed).multivariate_normal(np.zeros(15), cov, method="eigh")
    cov = cov + (N * np.array([position_m, position_m, position_m, yaw_rad]) ** 2) @ N.T
    moved_state = StateArrays.stack([true]).retract(d[None]).unstack(np.array([true.t_ns]))[0]
    return replace(moved_state, cov=cov)


def fly(
    flight: str,
    monkeypatch: pytest.MonkeyPatch,
    options: SlidingWindowOptions,
    position_m: float,
    yaw_rad: float,
    readout_s: float = 0.0,
) -> list[Prior]:
    """The priors along a flight, the first first."""
    priors: list[Prior] = []

    def recorded(problem: Problem, x: Variables) -> Prior:
        if not priors:
            priors.append(problem.prior)
        priors.append(marginalise_oldest(problem, x))
        return priors[-1]

    monkeypatch.setattr(window_module, "marginalise_oldest", recorded)
    calibration = CALIBRATION.with_camera(0, readout_s=readout_s)
    sequence = simulated_sequence(flight, seed=1, duration_s=10.0, calibration=calibration)
    # The less is believed of the readings, the less rounding leaves of the large in the small.
    sequence = replace(sequence, calibration=replace(calibration, imu=calibration.imu.times(4.0, 4.0)))
    start = start_in_the_dark(sequence.true_states[1], 1, position_m, yaw_rad)
    run = run_backend(since(sequence, 1), SlidingWindow(options), initial_state=start)
    assert run.completion == 1.0
    assert len(priors) > 5
    return priors


def known(prior: Prior) -> Float:
    """(4,) what the prior says of the unobservable directions, in all."""
    N = unobservable(prior)
    return np.diag(N.T @ prior.H @ N)


def cancelled(prior: Prior) -> Float:
    """(4,) the same as a part of what its entries would add up to, did they not cancel."""
    N = unobservable(prior)
    return known(prior) / np.diag(np.abs(N).T @ np.abs(prior.H) @ np.abs(N))


@pytest.mark.parametrize(("flight", "readout_s"), [*((flight, 0.0) for flight in FLIGHTS), ("figure_eight", 0.03)])
def test_prior_keeps_the_four_unobservable_directions(flight, readout_s, monkeypatch):
    """Whose start is hardly known: no flight may teach it where it is, nor where north is."""
    options = SlidingWindowOptions(calibrate_readout=readout_s != 0.0)
    priors = fly(flight, monkeypatch, options, 10.0, 1.0, readout_s)
    growth = np.array([known(prior) / known(priors[0]) for prior in priors])
    assert growth.max() < 1.0 + 1e-3
    assert cancelled(priors[-1]).max() < 2e-7


def test_without_first_estimates_yaw_becomes_known_and_position_does_not(monkeypatch):
    options = SlidingWindowOptions(first_estimate_jacobians=False)
    priors = fly("figure_eight", monkeypatch, options, 10.0, 1.0)
    growth = np.array([known(prior) / known(priors[0]) for prior in priors])
    assert growth[:, :3].max() < 1.0 + 1e-3
    assert growth[:, 3].max() > 100.0


@pytest.mark.parametrize("flight", FLIGHTS)
def test_what_was_known_of_position_and_yaw_never_grows(flight, monkeypatch):
    """Of a start known to a centimetre and half a degree; it fades, where a marginalised state was known better."""
    priors = fly(flight, monkeypatch, SlidingWindowOptions(), 0.01, 0.01)
    kept = np.array([known(prior) / known(priors[0]) for prior in priors])
    assert (np.diff(kept, axis=0) < 1e-6).all()
    assert (kept[-1] < 0.999).all()
    assert (kept[-1] > 0.2).all()


@pytest.mark.parametrize("calibration", [CALIBRATION, STEREO], ids=["mono", "stereo"])
def test_each_sighting_is_told_to_the_prior_once(calibration, monkeypatch):
    """In parts, while its landmark stays in sight; and what has been told is no longer said by the window."""
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=12.0, calibration=calibration)
    backend = SlidingWindow(SlidingWindowOptions(cauchy_sigmas=1.0))
    told: dict[tuple[int, int, int], float] = {}
    parts, left = [], []
    worth = window_module.worth_of_weights(1.0)

    def recorded(problem: Problem, x: Variables) -> Prior:
        window, s = backend.window, problem.sightings
        tracks = window.tracks
        hosted = tracks.ids[tracks.known & (tracks.hosts < tracks.cameras)]
        before = tracks.untold[np.isin(tracks.ids, hosted)]
        for i, v in zip(*np.nonzero(s.seen), strict=True):
            sighting = int(hosted[i]), window._t_ns[v // tracks.cameras], v % tracks.cameras
            assert before[i, v] == pytest.approx(1.0 - told.get(sighting, 0.0), abs=1e-12)
            parts.append(s.share[i, v] / worth)
            told[sighting] = told.get(sighting, 0.0) + parts[-1]
            if v < tracks.cameras:
                left.append(told[sighting])
        return marginalise_oldest(problem, x)

    monkeypatch.setattr(window_module, "marginalise_oldest", recorded)
    run_backend(since(sequence, 1), backend, initial_state=drawn_start(sequence, 1, 1))
    assert len(left) > 300
    np.testing.assert_allclose(left, 1.0, rtol=1e-12)
    assert max(told.values()) < 1.0 + 1e-12
    assert min(parts) > 0.0
    # Most of them in several parts.
    assert np.median(parts) < 0.5


@pytest.mark.parametrize("cauchy", [0.7, 1.0, 2.0, 1e6])
def test_an_estimate_by_a_robust_loss_is_worth_more_than_its_weights(cauchy):
    """Of where 100 points lie that are drawn around it, in 4000 trials."""
    noise = np.random.default_rng(0).normal(size=(4000, 100, 2))
    estimate = np.zeros((4000, 1, 2))
    for _ in range(40):
        w = 1.0 / (1.0 + ((noise - estimate) ** 2).sum(axis=2, keepdims=True) / cauchy**2)
        estimate = (w * noise).sum(axis=1, keepdims=True) / w.sum(axis=1, keepdims=True)
    known = 1.0 / estimate.var()
    assert known / w.sum(axis=1).mean() == pytest.approx(window_module.worth_of_weights(cauchy), rel=0.05)
