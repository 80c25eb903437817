"""The life of an estimate: how it begins, what a back-end may not say, and what is learned of the calibration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, STEREO, drawn_start
from threadpoolctl import threadpool_limits

from vioframe.errors import ConfigError, DivergedError, PluginError
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.options import EstimationOptions
from vioframe.geometry import so3
from vioframe.interfaces import Backend
from vioframe.parts import registry
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.types import (
    Calibration,
    CameraOnBody,
    Estimate,
    FrameTracks,
    ImuSegment,
    NavState,
    Start,
    Status,
)
from vioframe.warming import warm_up

BACKENDS = ("msckf", "sliding_window", "loose_ekf")


@cache
def flight(duration_s: float = 3.0) -> TrackSequence:
    return simulated_sequence("figure_eight", duration_s=duration_s, seed=1)


def created(name: str) -> Backend:
    return registry.load().create_backend(name)


def steady(t_ns: int) -> Estimate:
    """What nobody can object to."""
    state = NavState(t_ns, np.eye(3), *np.zeros((4, 3)), np.eye(15))
    return Estimate(Status.TRACKING, state, np.array([3, 5]), np.ones((2, 3)))


class Scripted:
    """Answers with what ``say`` makes of a steady estimate, and remembers what it was given."""

    def __init__(self, say: Any = lambda estimate: estimate) -> None:
        self._say = say
        self.starts: list[Start] = []
        self.still: list[bool] = []
        self.given: list[tuple[ImuSegment, FrameTracks]] = []

    def begin(self, start: Start) -> None:
        self.starts.append(start)

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Any:
        self.still.append(still)
        self.given.append((imu, tracks))
        return self._say(steady(tracks.t_ns))


def begun(backend: Any, options: EstimationOptions | None = None, sequence: TrackSequence | None = None) -> LifeCycle:
    """From the true state at the first frame."""
    sequence = sequence or flight()
    life = LifeCycle(backend, sequence.calibration, options, drawn_start(sequence, 0, 0))
    assert life.process(*sequence.packets[0]).status is Status.TRACKING
    return life


# Beginning.


def test_it_begins_at_the_state_given_with_the_noise_of_a_flight():
    backend, start = Scripted(), drawn_start(flight(), 0, 0)
    options = EstimationOptions(gyro_noise_factor=3.0, accel_noise_factor=5.0, accel_walk_factor=2.0)
    life = LifeCycle(backend, CALIBRATION, options, start)
    estimate = life.process(*flight().packets[0])
    assert estimate.events == ("initialised (state given)",)
    assert estimate.state is start
    (begin,) = backend.starts
    given = CALIBRATION.imu
    assert begin.noise_at_rest == given
    in_flight = begin.calibration.calibration.imu
    assert (in_flight.gyro_density, in_flight.accel_density) == (3 * given.gyro_density, 5 * given.accel_density)
    assert (in_flight.gyro_walk, in_flight.accel_walk) == (given.gyro_walk, 2 * given.accel_walk)
    assert begin.tracks.ids.tolist() == flight().packets[0][1].ids.tolist()
    # What is assumed in flight is no knowledge of the IMU.
    assert estimate.calibration.calibration.imu == given


@pytest.mark.parametrize("cov", [None, np.eye(15)])
def test_a_start_needs_a_covariance_and_a_camera_whose_rotation_is_known(cov):
    start = replace(drawn_start(flight(), 0, 0), cov=cov)
    calibration = CALIBRATION if cov is None else CALIBRATION.with_camera(0, rotation_known=False)
    with pytest.raises(ConfigError, match="needs a covariance, and cameras whose rotation on the body is known"):
        LifeCycle(Scripted(), calibration, None, start)


def test_a_start_of_another_instant_than_the_first_frame_is_refused():
    life = LifeCycle(Scripted(), CALIBRATION, None, drawn_start(flight(), 0, 0))
    with pytest.raises(ConfigError, match=r"the initial state is of \d+ ns, the first frame of \d+ ns"):
        life.process(*flight().packets[1])


@pytest.mark.parametrize("name", BACKENDS)
def test_cameras_may_take_turns(name):
    """Every other frame is of the right one alone; both find the start, and hold the scale."""
    sequence = simulated_sequence("figure_eight", duration_s=8.0, seed=1, calibration=STEREO)
    packets = [(imu, tracks.of_camera(k % 2)) for k, (imu, tracks) in enumerate(sequence.packets)]
    life = LifeCycle(created(name), STEREO)
    estimates = [life.process(imu, tracks) for imu, tracks in packets]
    states = {e.state.t_ns: e.state for e in estimates if e.state is not None}
    assert len(states) > 145
    assert next(e.events for e in estimates if e.state is not None) == ("initialised (stereo)",)
    assert not any(e.status is Status.LOST for e in estimates)
    truth = {state.t_ns: state for state in sequence.true_states}
    begin, end = (states[t_ns] for t_ns in (min(states), max(states)))
    flown, expected = (np.linalg.norm(b.p_WB - a.p_WB) for a, b in ((begin, end), (truth[begin.t_ns], truth[end.t_ns])))
    assert abs(flown - expected) < 0.02 * max(expected, 1.0)


def test_cameras_that_take_turns_tell_standstill_each_by_its_own_images():
    """The right one, too, and on its own once nothing comes from the left one any more."""
    sequence = simulated_sequence("figure_eight", duration_s=3.0, seed=1, calibration=STEREO)
    backend = Scripted()
    backend.takes_rigs = True
    life, picture = begun(backend, sequence=sequence), sequence.packets[0][1]
    for k, (imu, tracks) in enumerate(sequence.packets[1:]):
        camera = k % 2 if k < 40 else 1
        seen = picture if camera == 0 or k < 50 else tracks  # at last the body flies
        life.process(imu, replace(seen.of_camera(camera), t_ns=tracks.t_ns))
    still = [(tracks.camera[0], still) for (_, tracks), still in zip(backend.given, backend.still, strict=True)]
    assert all(stands for _, stands in still[12:46])
    assert {camera for camera, _ in still[12:40]} == {0, 1}
    assert not any(stands for _, stands in still[51:])


@pytest.mark.parametrize("name", BACKENDS)
def test_a_rig_begins_at_once_and_goes_on(name):
    """Of one of its cameras nothing comes for a while, then of the other."""
    sequence = simulated_sequence("figure_eight", duration_s=6.0, seed=2, calibration=STEREO)
    life, estimates = LifeCycle(created(name), STEREO), []
    for k, (imu, tracks) in enumerate(sequence.packets):
        black = 1 if 30 <= k < 45 else 0 if 60 <= k < 75 else None
        estimates.append(life.process(imu, tracks if black is None else tracks.only(tracks.camera != black)))
    begin = next(k for k, e in enumerate(estimates) if e.status is Status.TRACKING)
    assert estimates[begin].events[0] == "initialised (stereo)"
    assert begin < 12
    assert all(e.status is Status.TRACKING for e in estimates[begin:])
    learned = estimates[-1].calibration
    assert learned is not None
    assert len(learned.calibration.cameras) == len(learned.sigma) == 2
    truth = {state.t_ns: state for state in sequence.true_states}
    speed = [np.linalg.norm(s.v_WB) for s in (estimates[-1].state, truth[sequence.packets[-1][1].t_ns])]
    assert speed[0] == pytest.approx(speed[1], abs=0.2)


def test_a_rig_of_which_a_camera_may_sit_anyhow_is_refused_in_one_line():
    unknown = STEREO.with_camera(1, R_BC=np.full((3, 3), np.nan), rotation_known=False)
    with pytest.raises(ConfigError, match=r"^of a rig every camera's rotation on the body must be known.*cam1 is not$"):
        LifeCycle(created("msckf"), unknown)


def test_two_cameras_are_refused_in_one_line():
    camera = CALIBRATION.cameras[0]
    pair = replace(CALIBRATION, cameras=(camera, replace(camera, name="cam1")))
    with pytest.raises(ConfigError) as refused:
        LifeCycle(Scripted(), pair)
    assert "the calibration has cam0, cam1; choose one, as by --cameras cam0" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", BACKENDS)
def test_a_camera_turned_nobody_knows_how_begins_by_finding_out(name):
    """The truth lies within what the estimate says of its own accuracy, and within three degrees."""
    R_BC = so3.exp([0.6, -1.1, 0.9])
    true = CALIBRATION.with_camera(0, R_BC=R_BC)
    sequence = simulated_sequence("figure_eight", duration_s=8.0, seed=2, calibration=true)
    unknown = true.with_camera(0, R_BC=np.full((3, 3), np.nan), rotation_known=False)
    backend = created(name)
    warm_up(created(name), unknown)
    life = LifeCycle(backend, unknown)
    with threadpool_limits(1):
        estimates = [life.process(*packet) for packet in sequence.packets]
    begin = next(e for e in estimates if e.status is Status.TRACKING)
    assert begin.events[0] == "initialised (dynamic)"
    assert len(begin.events) == 2
    assert all(e.status is Status.TRACKING for e in estimates[estimates.index(begin) :])
    for estimate in (begin, estimates[-1]):
        assert estimate.calibration is not None
        (camera,), (sigma,) = estimate.calibration.calibration.cameras, estimate.calibration.sigma
        assert camera.rotation_known
        error = so3.log(camera.R_BC.T @ R_BC)
        assert np.degrees(np.linalg.norm(error)) < 3.0
        assert (np.abs(error) < 4.0 * sigma.rotation).all()
        assert np.degrees(sigma.rotation.max()) < 2.0
    moved = np.array([e.state.p_WB for e in estimates if e.state is not None])
    assert np.linalg.norm(np.diff(moved, axis=0), axis=1).sum() > 2.0


# What a back-end may not say.


def spoilt(**changes: Any) -> Any:
    """An estimate whose state is wrong in one place."""
    return lambda estimate: replace(estimate, state=replace(estimate.state, **changes))


ASYMMETRIC = np.eye(15)
ASYMMETRIC[2, 7] = 1e-3
NEGATIVE = np.eye(15)
NEGATIVE[4, 4] = -1e-3
DEFECTS = {
    "twice a rotation": (spoilt(R_WB=2.0 * np.eye(3)), "R_WB is not a rotation"),
    "mirrored": (spoilt(R_WB=np.diag([1.0, 1.0, -1.0])), "R_WB is not a rotation"),
    "a list for a matrix": (spoilt(R_WB=np.eye(3).tolist()), "R_WB is no array of numbers"),
    "another stamp": (spoilt(t_ns=7), "its state is of 7 ns, the frame of "),
    "NaN": (spoilt(v_WB=np.array([0.0, np.nan, 0.0])), "v_WB is not finite"),
    "infinite": (spoilt(bias_gyro_B=np.full(3, np.inf)), "bias_gyro_B is not finite"),
    "a column": (spoilt(p_WB=np.zeros((3, 1))), r"p_WB has the shape \(3, 1\), expected \(3,\)"),
    "asymmetric covariance": (spoilt(cov=ASYMMETRIC), "cov is not symmetric"),
    "negative covariance": (spoilt(cov=NEGATIVE), r"cov has the eigenvalue -1.00e-03"),
    "covariance that is not finite": (spoilt(cov=np.full((15, 15), np.nan)), "cov is not finite"),
    "covariance of the pose": (spoilt(cov=np.eye(6)), r"cov has the shape \(6, 6\), expected \(15, 15\)"),
    "no state": (lambda e: replace(e, state=None), "it tracks without a state"),
    "a pose for a state": (lambda e: replace(e, state=np.eye(4)), "its state is a ndarray, not a NavState"),
    "a text for a status": (lambda e: replace(e, status="fine"), "its status is 'fine', not a Status"),
    "a landmark too few": (lambda e: replace(e, p_WF=np.ones((1, 3))), r"p_WF has the shape \(1, 3\), expected \(2, 3"),
    "a landmark twice": (lambda e: replace(e, landmark_ids=np.array([3, 3])), "landmark_ids repeat"),
    "a list of landmarks": (lambda e: replace(e, landmark_ids=[3, 5]), "landmark_ids are not an array"),
    "a landmark nowhere": (lambda e: replace(e, p_WF=np.full((2, 3), np.nan)), "p_WF is not finite"),
    "negative seconds": (lambda e: replace(e, stage_seconds={"solve": -1.0}), "stage_seconds are negative"),
    "a bare calibration": (
        lambda e: replace(e, calibration=CALIBRATION),
        "its calibration is a Calibration, not a Cal",
    ),
    "nothing": (lambda e: None, "it returned a NoneType, not an Estimate"),
    "a state for an estimate": (lambda e: e.state, "it returned a NavState, not an Estimate"),
}


@pytest.mark.parametrize(("say", "defect"), DEFECTS.values(), ids=DEFECTS)
def test_an_estimate_that_cannot_be_is_an_error_of_the_plugin(say, defect):
    life = begun(Scripted(say))
    with pytest.raises(PluginError, match=rf"^the back-end Scripted at \d+ ns: {defect}.*; repair the plug-in$"):
        life.process(*flight().packets[1])


def test_an_estimate_that_nobody_can_object_to_passes():
    backend = Scripted(spoilt(cov=None))
    life = begun(backend)
    for packet in flight().packets[1:10]:
        assert life.process(*packet).status is Status.TRACKING
    assert len(backend.still) == 9
    assert len(backend.starts) == 1


# Losing, and beginning anew.


def diverging(estimate: Estimate) -> Estimate:
    raise DivergedError("it went to pieces")


def singular(estimate: Estimate) -> Estimate:
    raise np.linalg.LinAlgError("singular matrix")


LOSSES = {
    "raises": (diverging, "lost: it went to pieces"),
    "singular": (singular, "lost: singular matrix"),
    "too fast": (spoilt(v_WB=np.array([31.0, 0.0, 0.0])), "lost: the speed exceeds 30 m/s"),
    "biases": (spoilt(bias_accel_B=np.full(3, 2.0)), "lost: the IMU's biases became implausible"),
}


@pytest.mark.parametrize(("say", "event"), LOSSES.values(), ids=LOSSES)
def test_what_cannot_be_believed_is_lost_and_begun_anew(say, event):
    backend = Scripted(say)
    at_rest = simulated_sequence("standstill", pixel_sigma=0.1, duration_s=1.5)
    life = begun(backend, None, at_rest)
    estimate = life.process(*at_rest.packets[1])
    assert (estimate.status, estimate.state, estimate.events) == (Status.LOST, None, (event,))
    statuses = [life.process(*packet).status for packet in at_rest.packets[2:]]
    assert statuses[0] is Status.INITIALISING
    assert Status.TRACKING in statuses
    assert len(backend.starts) >= 2
    # Where it was when it was lost.
    np.testing.assert_array_equal(backend.starts[1].state.p_WB, backend.starts[0].state.p_WB)


def test_points_that_were_undistorted_by_another_lens_are_undistorted_anew():
    """As of frames that were begun before it was found."""
    other = CALIBRATION.with_camera(0, model=CALIBRATION.cameras[0].model.zoomed(1.1))
    life, (imu, tracks) = begun(backend := Scripted()), flight().packets[1]
    life.process(imu, tracks.undistorted(*other.lenses), other)
    expected = tracks.undistorted(*CALIBRATION.lenses).xy_normalised
    np.testing.assert_array_equal(backend.given[-1][1].xy_normalised, expected)


def test_a_backend_that_says_so_is_lost():
    life = begun(Scripted(lambda estimate: Estimate(Status.LOST, events=("lost: by its own account",))))
    assert life.process(*flight().packets[1]).events == ("lost: by its own account",)
    assert life.process(*flight().packets[2]).status is Status.INITIALISING


@pytest.mark.parametrize("max_blind_s", [0.32, 1.02])
def test_what_nothing_seen_corrects_is_given_up(max_blind_s):
    seen = iter([True] * 5 + [False] * 100)
    life = begun(Scripted(lambda e: replace(e, corrected=next(seen))), EstimationOptions(max_blind_s=max_blind_s))
    estimates = [life.process(*packet) for packet in flight().packets[1:40]]
    lost = next(k for k, estimate in enumerate(estimates) if estimate.status is Status.LOST)
    assert estimates[lost].events[0].startswith("lost: nothing usable was seen for")
    assert (lost - 4) / 20.0 == pytest.approx(max_blind_s + 0.03, abs=0.001)


def test_points_that_are_not_finite_reach_no_backend():
    class Looking(Scripted):
        def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Any:
            assert np.isfinite(tracks.xy_normalised).all()
            assert len(tracks.ids) == len(tracks.camera) == len(tracks.xy) == seen - 3
            return super().process(imu, tracks, still)

    life = begun(Looking())
    imu, tracks = flight().packets[1]
    seen = len(tracks.ids)
    xy_normalised = tracks.xy_normalised.copy()
    xy_normalised[[0, 4, 9]] = np.nan
    assert life.process(imu, replace(tracks, xy_normalised=xy_normalised)).status is Status.TRACKING


@pytest.mark.parametrize("update", [True, False])
def test_a_backend_is_told_that_the_images_stand_still(update):
    sequence = simulated_sequence("standstill", pixel_sigma=0.1, duration_s=1.5)
    backend = Scripted()
    life = begun(backend, EstimationOptions(zero_velocity_update=update), sequence)
    for packet in sequence.packets[1:]:
        life.process(*packet)
    assert not any(backend.still[:9])
    assert all(backend.still[10:]) is update
    assert any(backend.still) is update


def standing(sequence: TrackSequence, frames: int) -> list[tuple[ImuSegment, FrameTracks]]:
    """The packets behind the first, of which all but the last three of ``frames`` show the picture of the first."""
    first = sequence.packets[0][1]
    shown = [(imu, replace(first, t_ns=tracks.t_ns)) for imu, tracks in sequence.packets[1 : frames - 2]]
    return [*shown, *sequence.packets[frames - 2 : frames + 1]]


def test_standstill_reaches_the_backend_once_it_is_sure_and_what_follows_it_at_once():
    backend, sequence = Scripted(), flight()
    life, packets = begun(backend), standing(sequence, 24)
    lags, estimates = [], []
    for imu, tracks in packets:
        estimates.append(life.process(imu, tracks))
        lags.append((tracks.t_ns - backend.given[-1][1].t_ns) * 1e-9)
    assert [e.state.t_ns for e in estimates if e.state is not None] == [tracks.t_ns for _, tracks in packets]
    # Moving for all it knows; the frame in which it comes to rest; those of a while ago; and again the newest.
    assert lags[:10] == [0.0] * 10
    np.testing.assert_allclose(lags[10:14], [0.05, 0.1, 0.15, 0.2], atol=1e-3)
    assert max(lags) == lags[-4] == pytest.approx(0.2, abs=1e-3)
    assert lags[-3:] == [0.0] * 3
    assert backend.still == [False] * 9 + [True] * (len(backend.still) - 12) + [False] * 3
    # No reading is lost or given twice.
    for (before, _), (after, _) in zip(backend.given, backend.given[1:], strict=False):
        assert after.t_ns[0] == before.t_ns[-1]


def test_readings_lead_on_from_the_standstill_that_is_sure():
    """Until the back-end has them the body is where they put it, as surely as they do."""
    backend, sequence = Scripted(), flight()
    life = begun(backend)
    for imu, tracks in standing(sequence, 24)[:-3]:
        accel_B = np.broadcast_to([0.5, 0.0, 9.81], imu.accel_B.shape)
        estimate = life.process(replace(imu, gyro_B=np.zeros_like(imu.gyro_B), accel_B=accel_B), tracks)
    assert estimate.state is not None
    late_s = (estimate.state.t_ns - backend.given[-1][1].t_ns) * 1e-9
    assert late_s == pytest.approx(0.2, abs=1e-3)
    np.testing.assert_allclose(estimate.state.v_WB, [0.5 * late_s, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(estimate.state.p_WB, [0.25 * late_s**2, 0.0, 0.0], atol=1e-4)
    assert estimate.state.cov is not None
    assert (np.diag(estimate.state.cov)[:6] > 1.0).all()  # steady() is as unsure as that, and time goes by


def test_what_waits_is_forgotten_with_the_estimate_that_is_lost():
    backend = Scripted()
    sequence = simulated_sequence("standstill", pixel_sigma=0.1, duration_s=3.0)
    life = begun(backend, None, sequence)
    for packet in sequence.packets[1:20]:
        life.process(*packet)
    backend._say = diverging
    assert life.process(*sequence.packets[20]).status is Status.LOST
    backend._say = lambda estimate: estimate
    rest = [life.process(*packet) for packet in sequence.packets[21:]]
    began_ns = backend.starts[1].state.t_ns
    assert rest[-1].status is Status.TRACKING
    assert min(tracks.t_ns for _, tracks in backend.given[-5:]) > began_ns
    assert all(imu.t_ns[0] >= began_ns for imu, tracks in backend.given if tracks.t_ns > began_ns)


# Warming up, and the calibration.


def test_a_backend_may_refuse_the_flight_that_warms_it_up():
    warm_up(Scripted(diverging), CALIBRATION)
    with pytest.raises(ZeroDivisionError):
        warm_up(Scripted(lambda estimate: 1 / 0), CALIBRATION)


def off(calibration: Calibration) -> Calibration:
    """The camera sits otherwise than told, as far off as the prior allows."""
    (camera,) = calibration.cameras
    R_BC, p_BC = camera.R_BC @ so3.exp([0.004, -0.006, 0.005]), camera.p_BC + np.array([0.012, -0.015, 0.01])
    return calibration.with_camera(0, R_BC=R_BC, p_BC=p_BC)


def turned(camera: CameraOnBody, true: CameraOnBody) -> float:
    return float(np.linalg.norm(so3.log(camera.R_BC.T @ true.R_BC)))


@pytest.mark.parametrize("name", ["msckf", "sliding_window"])
def test_every_estimate_carries_what_is_learned_and_gets_surer(name):
    true = off(CALIBRATION)
    sequence = simulated_sequence("aggressive", duration_s=8.0, seed=3, calibration=true)
    life = begun(created(name), None, replace(sequence, calibration=CALIBRATION))
    with threadpool_limits(1):
        learned = [life.process(*packet).calibration for packet in sequence.packets[1:]]
    assert all(one is not None for one in learned)
    assert {one.calibration.imu for one in learned} == {CALIBRATION.imu}
    first, last = learned[0], learned[-1]
    assert (last.sigma[0].rotation < 0.5 * first.sigma[0].rotation).all()
    assert (last.sigma[0].position < first.sigma[0].position).all()
    assert last.sigma[0].time_offset_s < 0.5 * first.sigma[0].time_offset_s
    before, after = (turned(one.cameras[0], true.cameras[0]) for one in (CALIBRATION, last.calibration))
    assert after < 0.5 * before


def test_a_backend_that_learns_nothing_passes_on_what_it_began_with():
    sequence = flight()
    options = EstimationOptions(extrinsics_sigma_deg=2.0, extrinsics_sigma_m=0.05)
    life = begun(created("loose_ekf"), options)
    learned = [life.process(*packet).calibration for packet in sequence.packets[1:5]]
    for one in learned:
        assert one is not None
        (camera,), (given,) = one.calibration.cameras, CALIBRATION.cameras
        assert (camera.model, camera.time_offset_ns, one.calibration.imu) == (given.model, 0, CALIBRATION.imu)
        np.testing.assert_array_equal(camera.R_BC, given.R_BC)
        np.testing.assert_array_equal(camera.p_BC, given.p_BC)
        np.testing.assert_allclose(one.sigma[0].rotation, np.full(3, np.deg2rad(2.0)))
        np.testing.assert_array_equal(one.sigma[0].position, np.full(3, 0.05))
