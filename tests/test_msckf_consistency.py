"""Is the filter as good as it says? Gate rates, error against covariance over many flights, outliers, calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, EXACT, STEREO, drawn_start, pose_nees, since
from scipy.stats import chi2

from vioframe.bench import BackendRun, run_backend
from vioframe.estimation.options import EstimationOptions
from vioframe.geometry import so3
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.types import Calibration, CameraOnBody, Float, FrameTracks
from vioframe_msckf import backend as backend_module
from vioframe_msckf import updates
from vioframe_msckf.backend import Msckf
from vioframe_msckf.measurement import ACCEPTED, GATED
from vioframe_msckf.options import MsckfOptions

WHITE = MsckfOptions(landmark_drift=0.0)
"""Points that are simulated stay on their landmarks."""
CALIBRATED = replace(WHITE, calibrate_extrinsics=False, calibrate_time_offset=False, calibrate_intrinsics=False)


class GateCounts:
    """Counts what the gates say: ``tracks`` by verdict, ``landmarks`` and ``promoted`` ones (used, offered)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, wrong: frozenset[tuple[float, float]] = frozenset()) -> None:
        self.tracks: Counter[int] = Counter()
        self.wrong_tracks: Counter[int] = Counter()
        self.landmarks, self.promoted = np.zeros(2, int), np.zeros(2, int)
        self.wrong, self._finished = wrong, 0
        measure, update, use = updates.msckf_rows, updates.update_from_landmarks, updates.update_from_tracks

        def measured(window, xy, xy_normalised, seen, *arguments):
            found = measure(window, xy, xy_normalised, seen, *arguments)
            finished = (values[: self._finished] for values in (xy, seen, found.verdict.tolist()))
            for points, mask, verdict in zip(*finished, strict=True):
                spoilt = any(tuple(point) in self.wrong for point in points[mask].tolist())
                (self.wrong_tracks if spoilt else self.tracks)[verdict] += 1
            return found

        def updated(state, tracks, *arguments):
            offered = int(np.isin(tracks.ids, state.landmark_ids).sum())
            used = update(state, tracks, *arguments)
            self.landmarks += used, offered
            return used

        def used(state, observations, selection, *arguments):
            before, self._finished = len(state.landmark_ids), len(selection.finished)
            gone, *found = use(state, observations, selection, *arguments)
            self.promoted += len(state.landmark_ids) - before, np.isin(gone, selection.promoted).sum()
            return gone, *found

        monkeypatch.setattr(updates, "msckf_rows", measured)
        monkeypatch.setattr(backend_module, "update_from_landmarks", updated)
        monkeypatch.setattr(backend_module, "update_from_tracks", used)

    @property
    def rates(self) -> Float:
        """(3,) parts of tracks, landmarks and promoted ones that were accepted."""
        counts = (self.tracks[ACCEPTED], self.tracks[ACCEPTED] + self.tracks[GATED]), self.landmarks, self.promoted
        return np.array([accepted / offered for accepted, offered in counts])


def fly(
    sequence: TrackSequence, options: MsckfOptions, seed: int, estimation: EstimationOptions | None = None
) -> BackendRun:
    start = drawn_start(sequence, 1, 1000 + seed)
    return run_backend(since(sequence, 1), Msckf(options), estimation, start)


def moved(sequence: TrackSequence, by: Callable[[FrameTracks], Float]) -> TrackSequence:
    """Each frame's observations moved ``by`` (M, 2) px."""
    (camera,) = sequence.calibration.cameras
    packets = [(imu, replace(t, xy=t.xy + by(t)).undistorted(camera.model)) for imu, t in sequence.packets]
    return replace(sequence, packets=tuple(packets))


def carried(sequence: TrackSequence, part: float, first_px: float, more_px: float, seed: int) -> TrackSequence:
    """Points off by ``first_px`` on either axis, then by a ``part`` of what it was and ``more_px`` in each frame."""
    rng, off = np.random.default_rng(seed), dict[int, Float]()

    def by(tracks: FrameTracks) -> Float:
        for track in tracks.ids.tolist():
            new = rng.normal(size=2)
            off[track] = part * off[track] + more_px * new if track in off else first_px * new
        return np.array([off[track] for track in tracks.ids.tolist()])

    return moved(sequence, by)


def spoilt(sequence: TrackSequence, ratio: float, seed: int) -> tuple[TrackSequence, frozenset[tuple[float, float]]]:
    """Observations moved by 15 px in a random direction, and which."""
    rng, wrong = np.random.default_rng(seed), set[tuple[float, float]]()

    def astray(tracks: FrameTracks) -> Float:
        bad, angle = rng.random(len(tracks.ids)) < ratio, rng.uniform(0.0, 2.0 * np.pi, len(tracks.ids))
        off = bad[:, None] * 15.0 * np.column_stack([np.cos(angle), np.sin(angle)])
        wrong.update(map(tuple, (tracks.xy + off)[bad].tolist()))
        return off

    return moved(sequence, astray), frozenset(wrong)


@pytest.mark.parametrize(
    ("flight", "calibration"),
    [("figure_eight", CALIBRATION), ("aggressive", CALIBRATION), ("figure_eight", STEREO)],
    ids=["figure_eight", "aggressive", "stereo"],
)
def test_gates_accept_inliers_at_their_nominal_rate(flight, calibration, monkeypatch):
    counts = GateCounts(monkeypatch)
    fly(simulated_sequence(flight, seed=1, duration_s=20.0, calibration=calibration), CALIBRATED, 1)
    assert counts.tracks[ACCEPTED] + counts.tracks[GATED] > 2000
    assert counts.landmarks[1] > 5000
    assert counts.promoted[1] > 200
    # A degree of freedom more or less would make 0.98 or 0.85 of the landmarks' 0.95.
    assert (np.abs(counts.rates - 0.95) < [0.015, 0.015, 0.04]).all(), counts.rates


def test_the_gate_follows_its_quantile(monkeypatch):
    counts = GateCounts(monkeypatch)
    options = replace(CALIBRATED, gate_quantile=0.7)
    fly(simulated_sequence("figure_eight", seed=1, duration_s=10.0), options, 1)
    np.testing.assert_allclose(counts.rates, 0.7, atol=0.08)


@pytest.fixture
def filters(monkeypatch):
    """Those that begin, in turn."""
    begun, begin = [], Msckf.begin
    monkeypatch.setattr(Msckf, "begin", lambda self, start: begun.append(self) or begin(self, start))
    return begun


@pytest.mark.parametrize(("flown_px", "found_px"), [(0.1, 0.2), (0.7, 0.7), (1.5, 1.5)])
def test_noise_of_points_is_found_where_it_is_larger_than_was_taken_for_granted(
    flown_px, found_px, filters, monkeypatch
):
    counts = GateCounts(monkeypatch)
    fly(simulated_sequence("figure_eight", pixel_sigma=flown_px, seed=1, duration_s=15.0), MsckfOptions(), 1)
    assert filters[-1].point_noise.px == pytest.approx(found_px, rel=0.07)
    if flown_px >= found_px:
        # With the least noise that is taken for granted the gate would turn most of them away.
        assert counts.rates[0] > 0.85


def lasting(sequence: TrackSequence, sigma_px: float, alike: float, seed: int) -> TrackSequence:
    """Points that are off by ``sigma_px``, from frame to frame by what is correlated by ``alike``."""
    return carried(sequence, alike, sigma_px, np.sqrt(1.0 - alike**2) * sigma_px, seed)


@pytest.mark.parametrize(("alike", "tolerance"), [(0.0, 0.05), (0.5, 0.2)])
def test_errors_that_last_are_taken_for_as_much_noise_as_tells_as_little(alike, tolerance, filters):
    """A sum of errors that hang together by a part a in successive frames varies by (1 + a) / (1 - a) times more."""
    sequence = simulated_sequence("figure_eight", pixel_sigma=0.02, seed=1, duration_s=10.0)
    fly(lasting(sequence, 0.3, alike, 1), WHITE, 1, EXACT)
    expected = 0.3 * np.sqrt((1.0 + alike) / (1.0 - alike))
    assert filters[-1].point_noise.px == pytest.approx(expected, rel=tolerance)


def test_the_covariance_may_be_trusted_where_errors_of_points_last():
    values = []
    for seed in range(3):
        sequence = simulated_sequence("figure_eight", pixel_sigma=0.02, seed=seed, duration_s=12.0)
        run = fly(lasting(sequence, 0.3, 0.7, seed), WHITE, seed, EXACT)
        values.append(pose_nees(run.states, {s.t_ns: s for s in sequence.true_states}))
    low, high = chi2.ppf([0.025, 0.975], 9) / 3
    orientation, position = np.mean(values, axis=0)
    # Taken for white they make the latter 9.
    assert low < orientation < high
    assert low < position < high


def test_outliers_are_rejected_and_do_no_harm(monkeypatch):
    clean = simulated_sequence("figure_eight", seed=2, duration_s=15.0)
    sequence, wrong = spoilt(clean, 0.03, 2)
    counts = GateCounts(monkeypatch, wrong)
    run = fly(sequence, CALIBRATED, 2)
    assert run.completion == 1.0
    assert counts.wrong_tracks.total() > 300
    assert counts.wrong_tracks[ACCEPTED] < 0.02 * counts.wrong_tracks.total()
    # More than 0.95, as noise is taken for a quarter larger where a quarter of the tracks is spoilt.
    assert 0.92 < counts.tracks[ACCEPTED] / (counts.tracks[ACCEPTED] + counts.tracks[GATED]) < 0.998
    errors = [np.linalg.norm(s.p_WB - t.p_WB) for s, t in zip(run.states, clean.true_states[1:], strict=True)]
    assert max(errors) < 0.15


def jumping(sequence: TrackSequence, ratio: float, px: float, seed: int) -> TrackSequence:
    """Points of which some, others in each frame, are off by ``px`` more than the rest on either axis."""
    rng = np.random.default_rng(seed)
    return moved(sequence, lambda t: (rng.random(len(t.ids)) < ratio)[:, None] * px * rng.normal(size=t.xy.shape))


def test_points_that_jump_do_less_harm_by_a_robust_loss():
    squares = []
    for seed in range(3):
        clean = simulated_sequence("figure_eight", pixel_sigma=0.3, seed=seed, duration_s=10.0)
        sequence = jumping(clean, 0.2, 2.0, seed)
        runs = [fly(sequence, replace(WHITE, cauchy_sigmas=cauchy), seed, EXACT) for cauchy in (1.0, 1e3)]
        true = np.array([s.p_WB for s in clean.true_states[1:]])
        squares.append([np.mean((np.array([s.p_WB for s in run.states]) - true) ** 2) for run in runs])
    robust, not_robust = np.sqrt(np.mean(squares, axis=0))
    assert robust < 0.75 * not_robust


def sliding(sequence: TrackSequence, drift_px: float, seed: int) -> TrackSequence:
    """Points that walk off their landmarks by ``drift_px`` a frame on either axis."""
    return carried(sequence, 1.0, drift_px, drift_px, seed)


def test_landmarks_that_points_slide_off_are_not_believed_for_long():
    ratios = []
    for seed in range(3):
        clean = simulated_sequence("figure_eight", pixel_sigma=0.3, seed=seed, duration_s=15.0)
        truth = {s.t_ns: s for s in clean.true_states}
        runs = [fly(sliding(clean, 0.3, seed), o, seed, EXACT) for o in (WHITE, MsckfOptions())]
        ratios.append([sum(pose_nees(run.states, truth)) for run in runs])
    believed, doubted = np.mean(ratios, axis=0)
    assert doubted < 0.7 * believed


def mean_nees(
    flight: str, seeds: int, duration_s: float, options: MsckfOptions, calibration: Calibration = CALIBRATION
) -> tuple[float, float]:
    values = []
    for seed in range(seeds):
        sequence = simulated_sequence(flight, seed=seed, duration_s=duration_s, calibration=calibration)
        run = fly(sequence, options, seed, EXACT)
        assert run.completion == 1.0
        values.append(pose_nees(run.states, {s.t_ns: s for s in sequence.true_states}))
    orientation, position = np.mean(values, axis=0)
    return float(orientation), float(position)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flight", "calibration"),
    [
        ("figure_eight", CALIBRATION),
        pytest.param("aggressive", CALIBRATION, marks=pytest.mark.very_slow),
        ("figure_eight", STEREO),
    ],
    ids=["figure_eight", "aggressive", "stereo"],
)
def test_errors_are_as_large_as_the_covariance_says(flight, calibration):
    """Three degrees of freedom over twelve flights; errors within a flight hang together, so each counts as one."""
    flights = 12
    low, high = chi2.ppf([0.025, 0.975], 3 * flights) / flights
    orientation, position = mean_nees(flight, flights, 15.0, WHITE, calibration)
    assert low < orientation < high
    assert low < position < high


@pytest.mark.parametrize(("options", "told_ms"), [(CALIBRATED, 12), (WHITE, 12), (WHITE, 10)])
def test_a_camera_may_be_read_later_than_the_other(options, told_ms):
    """By 12 ms, as its calibration states beyond the first one's offset, or nearly so."""
    first_ns = STEREO.cameras[0].time_offset_ns
    true, told = (STEREO.with_camera(1, time_offset_ns=first_ns + 1_000_000 * ms) for ms in (12, told_ms))
    sequence = simulated_sequence("aggressive", seed=1, duration_s=8.0, calibration=true)
    run = fly(replace(sequence, calibration=told), options, 1, EXACT)
    errors = [np.linalg.norm(s.p_WB - t.p_WB) for s, t in zip(run.states, sequence.true_states[1:], strict=True)]
    assert run.completion == 1.0
    assert max(errors) < 0.06
    learned = run.estimates[-1].calibration
    assert learned is not None
    first, second = learned.calibration.cameras
    assert abs(second.time_offset_ns - first.time_offset_ns - 12e6) < 0.5e6


def test_without_first_estimates_the_covariance_is_too_small():
    sure, _ = mean_nees("figure_eight", 3, 20.0, replace(WHITE, first_estimate_jacobians=False))
    honest, _ = mean_nees("figure_eight", 3, 20.0, WHITE)
    assert honest < chi2.ppf(0.975, 9) / 3
    assert sure > 1.5 * honest


def test_calibration_converges_to_the_truth_within_its_own_uncertainty():
    """The camera sits and sees otherwise than the filter was told, as far off as its prior allows: measured by hand."""
    estimation = EstimationOptions(extrinsics_sigma_deg=0.3, extrinsics_sigma_m=0.015)
    (told,) = CALIBRATION.cameras
    true = replace(
        told,
        model=replace(told.model, fx=told.model.fx + 1.0, fy=told.model.fy - 1.2, cx=told.model.cx - 0.8),
        R_BC=told.R_BC @ so3.exp([0.004, -0.006, 0.005]),
        p_BC=told.p_BC + np.array([0.012, -0.015, 0.01]),
    )
    flown = replace(CALIBRATION, cameras=(true,))
    sequence = simulated_sequence("aggressive", seed=3, duration_s=20.0, calibration=flown, pixel_sigma=1.0)
    packets = tuple((imu, t.undistorted(told.model)) for imu, t in sequence.packets)
    sequence = replace(sequence, packets=packets, calibration=CALIBRATION)
    learned = fly(sequence, MsckfOptions(), 3, estimation).estimates[-1].calibration
    assert learned is not None
    (found,), (sure,) = learned.calibration.cameras, learned.sigma
    error, before = (_apart(true, camera) for camera in (found, told))
    sigma = np.concatenate([sure.rotation, sure.position, sure.intrinsics[:3]])
    assert np.abs(error / sigma).max() < 3.5
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        assert np.linalg.norm(error[part]) < 0.4 * np.linalg.norm(before[part])
    assert (sigma < 0.5 * np.repeat([0.005, 0.015, 1.0], 3)).all()


def _apart(true: CameraOnBody, camera: CameraOnBody) -> Float:
    """(9,) rotation, position, and fx fy cx of ``true`` beyond those of ``camera``."""
    lens = [getattr(true.model, name) - getattr(camera.model, name) for name in ("fx", "fy", "cx")]
    return np.concatenate([so3.log(camera.R_BC.T @ true.R_BC), true.p_BC - camera.p_BC, lens])
