"""The filter as a whole: its window, its events, what it does when it is lost, and that it repeats itself exactly."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from msckf_helpers import STEREO, drawn_start, random_covariance, since

from vioframe.bench import BackendRun, run_backend
from vioframe.errors import ConfigError
from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.recovery import continued_from
from vioframe.geometry import so3
from vioframe.parts import registry
from vioframe.simulation import simulated_sequence
from vioframe.types import Float, FrameTracks, NavState, Status
from vioframe_msckf.backend import Msckf
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.updates import Turns, select_tracks


def tracks(t_ns: int, ids: list[int]) -> FrameTracks:
    xy = np.array([[i, t_ns] for i in ids], dtype=np.float64).reshape(-1, 2)
    return FrameTracks(t_ns, np.array(ids, np.int64), np.zeros(len(ids), np.int64), xy, 0.1 * xy)


def blinded(packets, begin: int, end: int):
    """No tracks from frame ``begin`` to before ``end``."""
    return tuple((imu, tracks(seen.t_ns, []) if begin <= k < end else seen) for k, (imu, seen) in enumerate(packets))


def as_bytes(run: BackendRun) -> bytes:
    return b"".join(
        np.ascontiguousarray(x).tobytes()
        for s in run.states
        for x in (s.R_WB, s.p_WB, s.v_WB, s.bias_gyro_B, s.bias_accel_B, s.cov)
    )


def test_observations_are_filed_by_track_and_clone():
    table = TrackTable()
    for t_ns, ids in enumerate(([7, 3], [3, 5], [5, 7])):
        table.add_frame(tracks(t_ns, ids))
    assert table.ids.tolist() == [3, 5, 7]
    assert table.seen.tolist() == [[True, True, False], [False, True, True], [True, False, True]]
    for row, column in zip(*np.nonzero(table.seen), strict=True):
        assert table.xy[row, column].tolist() == [table.ids[row], column]
    assert (table.xy_normalised == 0.1 * table.xy).all()
    assert table.lengths().tolist() == [2, 2, 2]
    table.drop_frame(0)
    table.drop_frame(0)
    assert table.ids.tolist() == [5, 7]
    assert table.seen.tolist() == [[True], [True]]
    table.drop(np.array([0]))
    assert table.ids.tolist() == [7]


def test_what_does_not_count_is_in_view_all_the_same():
    table = TrackTable(cameras=2)
    both = replace(tracks(0, [1, 2, 1, 3]), camera=np.array([0, 0, 1, 1]))
    table.add_frame(both, np.array([True, True, False, True]))
    table.add_frame(both, np.array([True, True, False, False]))
    assert table.seen.tolist() == [[True, False, True, False], [True, False, True, False], [False, True, False, False]]
    assert table.in_view.tolist() == [[True] * 4, [True, False, True, False], [False, True, False, True]]
    assert table.lengths().tolist() == [2, 2, 1]
    assert table.in_sight().all()
    table.drop_frame(0)
    assert table.ids.tolist() == [1, 2, 3]


def test_what_a_camera_that_takes_its_turn_in_other_frames_saw_last_is_in_sight():
    def seen(*by_camera: list[int]) -> FrameTracks:
        frames = [tracks(0, ids) for ids in by_camera]
        camera = np.repeat(np.arange(len(frames)), [len(frame.ids) for frame in frames])
        return replace(tracks(0, [i for ids in by_camera for i in ids]), camera=camera)

    turns = Turns(2)
    expected = [
        (seen([1, 2], [2, 3]), [1, 2, 2, 3], 1),
        (seen([], [3, 4]), [1, 2, 3, 4], 2),
        (seen([2, 5], []), [2, 3, 4, 5], 2),
        (seen([5], []), [3, 4, 5], 3),
        (seen([], []), [], 4),
    ]
    for tracks_, in_sight, most in expected:
        turns.add_frame(tracks_)
        assert sorted(turns.in_sight) == in_sight
        assert turns.most == most
    turns.drop_oldest()
    assert turns.most == 3


def test_a_camera_whose_turn_does_not_come_within_a_window_has_none():
    turns, left, both = Turns(2), tracks(0, [1]), replace(tracks(0, [1, 2]), camera=np.array([0, 1]))
    turns.add_frame(both)
    for _ in range(3):
        turns.add_frame(left)
        assert sorted(turns.in_sight) == [1, 2]
    turns.drop_oldest()
    turns.add_frame(left)
    assert sorted(turns.in_sight) == [1]


def test_landmarks_of_cameras_that_take_turns_stay_in_the_state():
    sequence = simulated_sequence("figure_eight", duration_s=3.0, calibration=STEREO)
    packets = []
    for k, (imu, seen) in enumerate(sequence.packets):
        own = seen.of_camera(k % 2)
        packets.append((imu, replace(own, ids=2 * own.ids + own.camera)))  # nothing is seen by both
    lives: Counter[int] = Counter()

    class Counting(Msckf):
        def process(self, *packet):
            estimate = super().process(*packet)
            lives.update(self.state.landmark_ids.tolist())
            return estimate

    run_backend(
        since(replace(sequence, packets=tuple(packets)), 1), Counting(), initial_state=drawn_start(sequence, 1, 0)
    )
    assert np.median(list(lives.values())) >= 10


class Room:
    """All that the selection looks at of a state."""

    def __init__(self, landmarks: int) -> None:
        self.landmark_ids = range(landmarks)


def test_selection_takes_lost_tracks_first_and_full_ones_as_landmarks_while_there_is_room():
    table = TrackTable()
    # 1-3 reach back to the first clone and go on, 4 and 5 are lost after 3 and 4 views, 6 is lost after one, 7 is new.
    for t_ns, ids in enumerate(([1, 2, 3, 5, 6], [1, 2, 3, 4, 5], [1, 2, 3, 4, 5], [1, 2, 4, 5, 3], [1, 2, 3, 7])):
        table.add_frame(tracks(t_ns, ids))
    options = MsckfOptions(max_clones=5, min_track_length=3, max_slam_features=2, max_features=2)
    selection = select_tracks(table, Room(landmarks=1), options, True)
    assert table.ids.tolist() == [1, 2, 3, 4, 5, 7]
    assert table.ids[selection.promoted].tolist() == [1]
    assert table.ids[selection.finished].tolist() == [5, 4]

    more = replace(options, max_features=10)
    assert table.ids[select_tracks(table, Room(landmarks=1), more, True).finished].tolist() == [5, 4, 2, 3]
    assert table.ids[select_tracks(table, Room(landmarks=2), more, True).promoted].tolist() == []
    # A window that is not full yet lets go of nothing that can still be seen.
    assert table.ids[select_tracks(table, Room(landmarks=0), more, False).finished].tolist() == [5, 4]


@pytest.fixture(scope="module")
def lost_and_found():
    """A flight on which the camera sees nothing for five seconds."""
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=16.0)
    packets = blinded(sequence.packets, 120, 220)
    return sequence, run_backend(replace(sequence, packets=packets), Msckf())


def test_says_what_happened(lost_and_found):
    _, run = lost_and_found
    events = [(k, event) for k, estimate in enumerate(run.estimates) for event in estimate.events]
    begun = [k for k, event in events if event == "initialised (dynamic)"]
    lost = [k for k, event in events if event.startswith("lost: nothing usable was seen for")]
    assert len(begun) == 2
    assert begun[0] < 80
    # 4 s, the option's default, after the tracks that ended then were used up; and soon again after images are back.
    assert len(lost) == 1
    assert 120 + 80 < lost[0] < 120 + 85
    assert 220 < begun[1] < 280
    assert run.resets == 1
    assert run.estimates[lost[0]].status is Status.LOST
    assert run.estimates[lost[0]].state is None
    between = {e.status for e in run.estimates[lost[0] + 1 : begun[1]]}
    assert between == {Status.INITIALISING}
    assert any("refused" in event for k, event in events if lost[0] < k < begun[1])


def test_goes_on_from_where_it_was_lost(lost_and_found):
    sequence, run = lost_and_found
    states = run.states
    again = next(k for k in range(1, len(states)) if states[k].t_ns - states[k - 1].t_ns > 1e8)
    before, first = states[again - 1], states[again]
    np.testing.assert_array_equal(first.p_WB, before.p_WB)
    turn = first.R_WB @ before.R_WB.T
    assert abs(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])) < 1e-6
    # From there on it flies as well as it did before: true displacements, up to the yaw it began again with.
    truth = {state.t_ns: state for state in sequence.true_states}
    flown = np.array([s.p_WB - first.p_WB for s in states[again:]])
    true = np.array([truth[s.t_ns].p_WB - truth[first.t_ns].p_WB for s in states[again:]])
    C = true.T @ flown
    R = so3.exp([0.0, 0.0, np.arctan2(C[1, 0] - C[0, 1], C[0, 0] + C[1, 1])])
    assert np.linalg.norm(true[-1]) > 1.0
    assert np.linalg.norm(flown @ R.T - true, axis=1).max() < 0.1


@pytest.mark.parametrize("last_pitch", [0.1, -0.1])
@pytest.mark.parametrize("R_LB", [np.eye(3), np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])])
def test_a_new_start_keeps_tilt_and_takes_over_position_and_yaw(R_LB, last_pitch):
    """However the IMU is mounted: EuRoC's has its x axis straight up."""
    rng = np.random.default_rng(0)
    last = NavState(0, so3.exp([0.0, 0.0, 2.0]) @ so3.exp([0.0, last_pitch, 0.0]) @ R_LB, np.ones(3), *np.zeros((3, 3)))
    R_WB = so3.exp([0.0, 0.0, -1.0]) @ R_LB
    initial = NavState(5, R_WB, *rng.normal(size=(4, 3)), random_covariance(rng, 15))
    moved = continued_from(last, initial)
    turn = so3.exp([0.0, 0.0, 3.0])
    np.testing.assert_allclose(moved.R_WB, turn @ initial.R_WB, atol=1e-12)
    np.testing.assert_allclose(moved.v_WB, turn @ initial.v_WB, atol=1e-12)
    np.testing.assert_array_equal(moved.p_WB, last.p_WB)
    np.testing.assert_array_equal(moved.bias_gyro_B, initial.bias_gyro_B)
    np.testing.assert_array_equal(moved.bias_accel_B, initial.bias_accel_B)
    assert moved.t_ns == 5
    # A turn of the world turns errors of position and velocity, and leaves those in the body as they are.
    G = _block_diagonal(np.eye(3), turn, turn, np.eye(3), np.eye(3))
    assert initial.cov is not None
    np.testing.assert_allclose(moved.cov, G @ initial.cov @ G.T, atol=1e-12)


def _block_diagonal(*blocks: Float) -> Float:
    out = np.zeros((15, 15))
    for k, block in enumerate(blocks):
        out[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    return out


def test_short_blindness_is_flown_through():
    sequence = simulated_sequence("figure_eight", seed=2, duration_s=10.0)
    packets = blinded(sequence.packets, 100, 130)
    start = drawn_start(sequence, 1, 2)
    run = run_backend(since(replace(sequence, packets=packets), 1), Msckf(), initial_state=start)
    assert run.completion == 1.0
    assert np.linalg.norm(run.states[-1].p_WB - sequence.true_states[-1].p_WB) < 0.1


@pytest.mark.parametrize(
    ("wrong", "why"),
    [({"v_WB": np.array([0.0, 50.0, 0.0])}, "speed"), ({"bias_accel_B": np.array([4.0, 0.0, 0.0])}, "biases")],
)
def test_implausible_states_are_given_up(wrong, why):
    sequence = simulated_sequence("figure_eight", duration_s=2.0)
    start = replace(drawn_start(sequence, 1, 0), **wrong)
    life = LifeCycle(Msckf(), sequence.calibration, initial_state=start)
    assert life.process(*sequence.packets[1]).status is Status.TRACKING
    estimate = life.process(*sequence.packets[2])
    assert estimate.status is Status.LOST
    assert why in estimate.events[0]


def test_readings_that_are_not_finite_lose_the_filter_and_nothing_worse():
    sequence = simulated_sequence("figure_eight", duration_s=2.0)
    life = LifeCycle(Msckf(), sequence.calibration, initial_state=drawn_start(sequence, 1, 0))
    for packet in sequence.packets[1:20]:
        assert life.process(*packet).status is Status.TRACKING
    imu, seen = sequence.packets[20]
    estimate = life.process(replace(imu, gyro_B=np.full_like(imu.gyro_B, np.nan)), seen)
    assert estimate.status is Status.LOST
    assert estimate.state is None
    assert life.process(*sequence.packets[21]).status is Status.INITIALISING


def test_estimates_are_finite_and_rotations_orthonormal():
    sequence = simulated_sequence("aggressive", seed=4, duration_s=20.0)
    backend = Msckf()
    run = run_backend(since(sequence, 1), backend, initial_state=drawn_start(sequence, 1, 4))
    assert run.completion == 1.0
    for estimate in run.estimates:
        state = estimate.state
        assert np.abs(state.R_WB.T @ state.R_WB - np.eye(3)).max() < 1e-11
        assert np.linalg.det(state.R_WB) == pytest.approx(1.0, abs=1e-11)
        for values in (state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B, state.cov, estimate.p_WF):
            assert np.isfinite(values).all()
        assert (state.cov == state.cov.T).all()
        assert np.linalg.eigvalsh(state.cov)[0] > 0.0
        assert len(estimate.landmark_ids) == len(estimate.p_WF) == len(set(estimate.landmark_ids.tolist()))
    assert backend.state is not None
    P = backend.state.cov
    assert np.linalg.eigvalsh(P)[0] > -1e-14 * np.linalg.eigvalsh(P)[-1]


def test_window_and_landmarks_keep_to_their_limits():
    sequence = simulated_sequence("figure_eight", seed=5, duration_s=5.0)
    options = MsckfOptions(max_clones=6, max_slam_features=10, max_features=5)
    backend = Msckf(options)
    life = LifeCycle(backend, sequence.calibration, initial_state=drawn_start(sequence, 1, 5))
    most = 0
    for packet in sequence.packets[1:]:
        life.process(*packet)
        assert len(backend.state.clones) < options.max_clones
        assert len(backend.state.landmark_ids) <= options.max_slam_features
        most = max(most, len(backend.state.landmark_ids))
    assert most == options.max_slam_features


def test_two_runs_are_the_same_to_the_last_bit():
    sequence = simulated_sequence("figure_eight", seed=6, duration_s=6.0)
    first, second = (as_bytes(run_backend(sequence, Msckf())) for _ in range(2))
    assert len(first) > 50 * 8 * 246
    assert first == second


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_clones": 2},
        {"max_features": 0},
        {"min_track_length": 1},
        {"max_slam_features": -1},
        {"pixel_sigma": 0.0},
        {"gate_quantile": 1.0},
    ],
)
def test_impossible_options_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(ConfigError, match=f"{name}=.* should be"):
        registry.load().create_backend("msckf", wrong)
