"""Of what several cameras see at once, what counts."""

from dataclasses import replace

import numpy as np
import pytest
from msckf_helpers import STEREO, drawn_start

from vioframe.bench import run_backend
from vioframe.estimation.repeats import Repeats
from vioframe.parts import registry
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.types import NS_PER_S, FrameTracks

FRAME_NS = NS_PER_S // 20


def seen(t_ns, *by_camera):
    """A frame in which each camera sees points of these ids; None has no part in it."""
    ids = np.concatenate([np.asarray(ids, np.int64) for ids in by_camera if ids is not None])
    camera = np.concatenate([np.full(len(ids), c) for c, ids in enumerate(by_camera) if ids is not None])
    return FrameTracks(t_ns, ids, camera, np.zeros((len(ids), 2)), np.zeros((len(ids), 2)))


def counted(repeats, t_ns, *by_camera):
    """What counts of it, a list of ids a camera."""
    tracks = seen(t_ns, *by_camera)
    tracks = tracks.only(repeats.counting(tracks))
    return [tracks.ids[tracks.camera == c].tolist() for c in range(len(by_camera))]


def test_a_second_camera_counts_at_first_and_then_every_half_second_where_another_sees_the_same():
    repeats = Repeats(2, 0.5)
    by_second = [counted(repeats, k * FRAME_NS, [0, 1], [0, 1, 7])[1] for k in range(21)]
    assert [k for k, ids in enumerate(by_second) if 0 in ids and 1 in ids] == [0, 10, 20]
    assert all(7 in ids for ids in by_second)


def test_what_comes_later_has_its_own_half_second():
    repeats = Repeats(2, 0.5)
    by_second = [counted(repeats, k * FRAME_NS, [0, 1], [0, 1] if k > 3 else [0])[1] for k in range(16)]
    assert [k for k, ids in enumerate(by_second) if 1 in ids] == [4, 14]


def test_the_first_camera_always_counts():
    repeats = Repeats(2, 0.5)
    assert all(counted(repeats, k * FRAME_NS, [0, 1], [1, 2])[0] == [0, 1] for k in range(12))


def test_a_camera_counts_at_once_where_the_one_ahead_has_lost_the_point():
    repeats = Repeats(2, 0.5)
    counted(repeats, 0, [0, 5], [0])
    assert counted(repeats, FRAME_NS, [0, 5], [0])[1] == []
    assert all(counted(repeats, k * FRAME_NS, [5], [0])[1] == [0] for k in range(2, 6))


def test_a_camera_counts_once_the_one_ahead_has_shown_nothing_for_longer_than_turns_take():
    repeats = Repeats(2, 0.5)
    counted(repeats, 0, [0], [0])
    assert counted(repeats, FRAME_NS, [0], [0])[1] == []
    assert [counted(repeats, k * FRAME_NS, None, [0])[1] for k in (2, 3, 4)] == [[], [0], [0]]


def test_cameras_that_take_turns_repeat_each_other_all_the_same():
    repeats, by_second = Repeats(2, 0.5), []
    for k in range(12):
        counted(repeats, k * FRAME_NS, [0, 1], None)
        by_second.append(counted(repeats, k * FRAME_NS + 20_000_000, None, [0, 1])[1])
    assert [k for k, ids in enumerate(by_second) if ids] == [0, 10]


def test_of_three_cameras_each_counts_once():
    repeats = Repeats(3, 0.5)
    of_all = [counted(repeats, k * FRAME_NS, [0], [0, 1], [0, 1]) for k in range(10)]
    assert of_all[0] == [[0], [0, 1], [0, 1]]
    assert all(later == [[0], [1], []] for later in of_all[1:])


@pytest.mark.parametrize("every_s", [0.0, 0.5])
def test_nothing_is_left_out_of_one_camera_nor_where_all_is_to_count(every_s):
    tracks = seen(0, [0, 1]) if every_s else seen(0, [0, 1], [0, 1])
    repeats = Repeats(len(np.unique(tracks.camera)), every_s)
    assert all(repeats.counting(replace(tracks, t_ns=k * FRAME_NS)).all() for k in range(3))


@pytest.mark.parametrize(("every_s", "same"), [(0.5, True), (0.0, False)])
def test_the_filter_takes_no_notice_of_what_does_not_count(every_s, same):
    """Neither in tracks nor in landmarks: where else it was seen changes nothing, to the last bit."""
    sequence = simulated_sequence("figure_eight", duration_s=3.0, seed=1, pixel_sigma=0.3, calibration=STEREO)
    repeats, packets = Repeats(2, 0.5), [sequence.packets[0]]
    for imu, tracks in sequence.packets[1:]:
        off_px = np.where(repeats.counting(tracks), 0.0, 1.0)[:, None]
        packets.append((imu, replace(tracks, xy=tracks.xy + off_px).undistorted(*STEREO.lenses)))
    assert (flown(replace(sequence, packets=tuple(packets)), every_s) == flown(sequence, every_s)) is same


def flown(sequence: TrackSequence, every_s: float) -> list[list[float]]:
    """Where the filter says that the body is, from the true start."""
    backend = registry.load().create_backend("msckf", {"shared_every_s": every_s})
    return [state.p_WB.tolist() for state in run_backend(sequence, backend, None, drawn_start(sequence, 0, 0)).states]
