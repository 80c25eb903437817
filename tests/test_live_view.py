"""A run that is watched while it is flown: what is shown, that no flight waits for it, and that nothing grows."""

import logging
import weakref
from threading import Event
from time import sleep

import cv2
import numpy as np
import pytest
from recordings import PAIR
from rendered_flight import CALIBRATION, rendered_flight
from test_view import recorded
from trajectory_helpers import PERIOD_NS, flight

from vioframe import Odometry
from vioframe.errors import PluginError, RunError
from vioframe.geometry import so3
from vioframe.report import live_view
from vioframe.report.live_view import LiveView
from vioframe.types import (
    DBA,
    DBG,
    DP,
    NS_PER_S,
    Estimate,
    FrameSet,
    FrameTracks,
    MapCorrection,
    NavState,
    Status,
    Step,
)

pytest.importorskip("rerun")
# rerun warns, and goes on, where it is given what it cannot take.
pytestmark = [
    pytest.mark.filterwarnings("error", "ignore:RRD file has no footer"),
    pytest.mark.usefixtures("no_display"),
]

AT = "/world/flight"
IMAGE = np.zeros(CALIBRATION.cameras[0].model.resolution[::-1], np.uint8)


@pytest.fixture(scope="module")
def steps():
    """6 s with the filter, of which it initialises for the first."""
    odometry, measurements = Odometry(CALIBRATION), rendered_flight().measurements
    last_ns = measurements[0].t_ns + 6 * NS_PER_S
    return [step for m in measurements if m.t_ns <= last_ns for step in odometry.add(m)]


@pytest.fixture(scope="module")
def shown(steps, tmp_path_factory):
    """What is in the recording of that flight, of which every frame took 30 ms and one was dropped."""
    return watched(steps, tmp_path_factory.mktemp("live_view"), latency_ms=30.0, dropped=1)


def watched(steps, folder, calibration=CALIBRATION, **late):
    with LiveView("flight", calibration, folder / "out" / "v.rrd") as view:
        for step in steps:
            view.add(step, **late)
            while view._waiting._frames:  # as a flight goes on, not as fast as it can be told of
                sleep(1e-3)
    assert view.left_out == 0
    return recorded(folder / "out" / "v.rrd")


def tracked(steps):
    return [step for step in steps if step.estimate.status is Status.TRACKING]


def since_begin(steps, of):
    return [step.frames.t_ns - steps[0].frames.t_ns for step in of]


def by_time(shown, path, name):
    """The rows of a component by their times in ns."""
    values, times = shown
    return dict(zip(times[path], values[path, name], strict=True))


def made_up(n, ids=lambda k: np.arange(3 * k, 3 * k + 12), images=(IMAGE,), lost=(), **fields):
    """Steps at 20 Hz of a flight that is known but for those ``lost``; landmark i is at (i, i, i)."""
    truth, out = flight(n), []
    for k, t_ns in enumerate(truth.t_ns.tolist()):
        seen = ids(k)
        zeros = np.zeros((len(seen), 2))
        tracks = FrameTracks(t_ns, seen, np.zeros(len(seen), np.int64), zeros + k, zeros)
        still = np.zeros(3)
        state = NavState(t_ns, truth.R_WB[k], truth.p_WB[k], still + k, still, still, 1e-4 * np.eye(15))
        estimate = Estimate(Status.TRACKING, state, seen, np.repeat(seen[:, None], 3, axis=1).astype(float))
        if k in lost:
            estimate = Estimate(Status.LOST, events=("lost: made up",))
        frames = FrameSet(t_ns, images(k) if callable(images) else images)
        out.append(Step(frames, tracks, estimate, {"klt": 1e-3, "backend": 2e-3, "backend.update": 1e-3}, **fields))
    return out


def test_the_body_flies_as_it_was_estimated(steps, shown):
    values, times = shown
    flown = tracked(steps)
    assert 40 < len(flown) < len(steps)
    assert times[f"{AT}/body"] == since_begin(steps, flown)
    p_WB = np.array(values[f"{AT}/body", "Transform3D:translation"])[:, 0]
    np.testing.assert_allclose(p_WB, [step.estimate.state.p_WB for step in flown], atol=1e-5)
    R_WB = np.array(values[f"{AT}/body", "Transform3D:mat3x3"]).reshape(-1, 3, 3).transpose(0, 2, 1)
    np.testing.assert_allclose(R_WB, [step.estimate.state.R_WB for step in flown], atol=1e-6)
    half_sizes = np.array(values[rf"{AT}/3\ sigma", "Ellipsoids3D:half_sizes"])[:, 0]
    cov = np.array([step.estimate.state.cov[DP, DP] for step in flown])
    shown_at = np.isin(times[f"{AT}/body"], times[rf"{AT}/3\ sigma"])
    np.testing.assert_allclose(half_sizes**2, 9.0 * np.linalg.eigvalsh(cov[shown_at]), rtol=1e-4)


def test_the_path_grows_by_pieces_and_ends_with_the_trajectory(steps, shown):
    values, times = shown
    p_WB = np.array([step.estimate.state.p_WB for step in tracked(steps)])
    pieces = [strip for row in values[f"{AT}/path", "LineStrips3D:strips"] for strip in row]
    newest = values[rf"{AT}/newest\ path", "LineStrips3D:strips"][-1]
    assert max(map(len, pieces)) == 11  # a second, and where the one before ended
    joined = np.concatenate([pieces[0], *(strip[1:] for strip in [*pieces[1:], *newest])])
    np.testing.assert_allclose(joined, p_WB, atol=1e-5)
    assert times[rf"{AT}/newest\ path"][-1] == since_begin(steps, steps[-1:])[0]


def test_pictures_show_their_tracks_coloured_by_age(steps, shown):
    values, times = shown
    camera = f"{AT}/body/cam0"
    stamps = since_begin(steps, steps)
    assert times[f"{camera}/image"] == times[f"{camera}/tracks"] == times[f"{camera}/tracks/tails"] == stamps
    first: dict[int, int] = {}
    colours: dict[int, set[int]] = {}
    for k, step in enumerate(steps):
        (jpeg,) = values[f"{camera}/image", "EncodedImage:blob"][k]
        image = cv2.imdecode(np.array(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert np.corrcoef(image.ravel(), step.frames.images[0].ravel())[0, 1] > 0.95
        xy = values[f"{camera}/tracks", "Points2D:positions"][k]
        np.testing.assert_allclose(xy, step.tracks.xy, atol=1e-3)
        ages = [k - first.setdefault(i, k) for i in step.tracks.ids.tolist()]
        for age, colour in zip(ages, values[f"{camera}/tracks", "Points2D:colors"][k], strict=True):
            colours.setdefault(age, set()).add(colour)
    assert colours[0] == {0xFFFFFFFF}
    assert len(colours) == len(steps)
    assert all(len(each) == 1 for each in colours.values())
    assert len({each for (each,) in colours.values()}) > 50
    green = [next(iter(colours[age])) >> 16 & 0xFF for age in range(len(steps))]
    assert green == sorted(green, reverse=True)


def test_tails_lead_from_where_tracks_were(steps, shown):
    values, _ = shown
    where = [dict(zip(step.tracks.ids.tolist(), step.tracks.xy, strict=True)) for step in steps]
    for k in (0, 2, 40):
        tails = np.array(values[f"{AT}/body/cam0/tracks/tails", "LineStrips2D:strips"][k])
        for tail, i in zip(tails, steps[k].tracks.ids.tolist(), strict=True):
            seen = [at[i] for at in where[max(k - 3, 0) : k + 1] if i in at]
            np.testing.assert_allclose(tail, [seen[0]] * (4 - len(seen)) + seen, atol=1e-3)


def test_landmarks_in_view_are_where_they_are_believed_to_be_by_now(steps, shown):
    newest: dict[int, np.ndarray] = {}
    compared = 0
    rows = by_time(shown, rf"{AT}/landmarks\ in\ view", "Points3D:positions")
    for step, t in zip(tracked(steps), since_begin(steps, tracked(steps)), strict=True):
        newest |= zip(step.estimate.landmark_ids.tolist(), step.estimate.p_WF, strict=True)
        expected = np.array([newest[i] for i in step.tracks.ids.tolist() if i in newest]).reshape(-1, 3)
        points = np.array(rows[t]).reshape(-1, 3)
        np.testing.assert_allclose(np.sort(points, axis=0), np.sort(expected, axis=0), atol=1e-4)
        compared += len(points)
    assert compared > 1000


def test_landmarks_out_of_view_stay_once_as_they_were_last(tmp_path):
    """Of frame k those are in view that are called 3 k to 3 k + 11."""
    values, times = watched(made_up(101), tmp_path)
    rows = values[f"{AT}/landmarks", "Points3D:positions"]
    assert times[f"{AT}/landmarks"] == [s * NS_PER_S for s in range(6)]
    names = np.concatenate([np.array(row).reshape(-1, 3) for row in rows])[:, 0]
    np.testing.assert_array_equal(names, np.arange(3 * 100))


def test_the_cameras_sit_on_the_body_as_it_was_learned(steps, shown):
    values, times = shown
    at = f"{AT}/body/cam0"
    learned = steps[-1].estimate.calibration.calibration.cameras[0]
    np.testing.assert_allclose(values[at, "Transform3D:translation"][0][0], CALIBRATION.cameras[0].p_BC, rtol=1e-6)
    assert times[at][-1] >= since_begin(steps, steps[-1:])[0] - NS_PER_S
    row = times[at].index(times[at][-1])
    then = next(s for s, t in zip(steps, since_begin(steps, steps), strict=True) if t == times[at][row])
    then = then.estimate.calibration.calibration.cameras[0]
    assert not np.array_equal(then.p_BC, CALIBRATION.cameras[0].p_BC)
    np.testing.assert_allclose(values[at, "Transform3D:translation"][-1][0], then.p_BC, rtol=1e-6)
    R_BC = np.reshape(values[at, "Transform3D:mat3x3"][-1][0], (3, 3)).T
    np.testing.assert_allclose(R_BC, then.R_BC, atol=1e-6)
    assert values[at, "Pinhole:resolution"][0][0] == [*map(float, learned.model.resolution)]


def test_states_are_plotted_within_their_bounds(steps, shown):
    values, times = shown
    states = [step.estimate.state for step in tracked(steps)]
    sigma = np.sqrt([np.diagonal(state.cov) for state in states])
    for k, axis in enumerate("xyz"):
        assert times[f"/velocity/{axis}/flight"] == since_begin(steps, tracked(steps))
        velocity = np.array(values[f"/velocity/{axis}/flight", "Scalars:scalars"])[:, 0]
        np.testing.assert_allclose(velocity, [state.v_WB[k] for state in states], atol=1e-12)
        for name, part, own in (("gyro", "bias_gyro_B", DBG), ("accel", "bias_accel_B", DBA)):
            rows = np.array(values[f"/bias_{name}/{axis}/flight", "Scalars:scalars"])
            bias, bound = np.array([getattr(state, part)[k] for state in states]), 3.0 * sigma[:, own][:, k]
            np.testing.assert_allclose(rows.T, [bias, bias - bound, bias + bound], atol=1e-12)
        rows = np.array(values[f"/sigma_position/{axis}/flight", "Scalars:scalars"])[:, 0]
        np.testing.assert_allclose(rows, 3.0 * sigma[:, DP][:, k], atol=1e-12)


def test_work_is_plotted_of_every_frame(steps, shown):
    values, times = shown
    stages = {path: rows for (path, name), rows in values.items() if path.startswith("/stages/") and "scalars" in name}
    assert set(stages) == {f"/stages/flight/{stage}" for stage in ("equalise", "klt", "reject", "detect", "backend")}
    in_all = np.array(values["/time/flight", "Scalars:scalars"])[:, 0]
    np.testing.assert_allclose(in_all, np.sum([*stages.values()], axis=0)[:, 0])
    seconds = [sum(s for stage, s in step.stage_seconds.items() if "." not in stage) for step in steps]
    np.testing.assert_allclose(in_all, 1e3 * np.array(seconds))
    assert values["/latency/flight", "Scalars:scalars"] == [[30.0]] * len(steps)
    assert values["/features/flight/tracked", "Scalars:scalars"] == [[len(step.tracks.ids)] for step in steps]
    known, new = set(), []
    for step in steps:
        new.append([len({*step.tracks.ids.tolist()} - known)])
        known |= {*step.tracks.ids.tolist()}
    assert values["/features/flight/new", "Scalars:scalars"] == new
    assert times["/time/flight"] == since_begin(steps, steps)


def test_what_happens_is_said_once(steps, shown, tmp_path):
    values, times = shown
    said = [row[0] for row in values["/status/flight", "TextLog:text"]]
    assert said[0] == "initialising"
    assert [text for text in said if text.startswith("initialised")] == ["initialised (static)"]
    assert said.count("frames dropped: 1, 1 by now") == 1
    assert times["/status/flight"][said.index("initialised (static)")] == since_begin(steps, tracked(steps))[0]
    values, _ = watched(made_up(40, lost=(10, 11, 30)), tmp_path)
    said = [row[0] for row in values["/status/flight", "TextLog:text"]]
    assert said == ["tracking", "lost: made up", "tracking", "lost", "tracking"]
    levels = [row[0] for row in values["/status/flight", "TextLog:level"]]
    assert levels == ["INFO", "WARN", "INFO", "WARN", "INFO"]


def test_nothing_is_drawn_where_nothing_was_estimated(tmp_path):
    steps = made_up(60, lost=range(25, 30))
    values, times = watched(steps, tmp_path)
    p_WB = flight(60).p_WB
    strips = [strip for row in values[f"{AT}/path", "LineStrips3D:strips"] for strip in row]
    strips += values[rf"{AT}/newest\ path", "LineStrips3D:strips"][-1]
    before, after = strips[:2], strips[2:]
    np.testing.assert_allclose(np.concatenate([before[0], before[1][1:]]), p_WB[:25], atol=1e-5)
    np.testing.assert_allclose(np.concatenate([after[0], *(each[1:] for each in after[1:])]), p_WB[30:], atol=1e-5)
    velocity = np.array(values["/velocity/x/flight", "Scalars:scalars"])[:, 0]
    assert np.flatnonzero(np.isnan(velocity)).tolist() == [25]
    assert not by_time((values, times), rf"{AT}/landmarks\ in\ view", "Points3D:positions")[25 * PERIOD_NS]


def test_there_is_one_time_line(steps, tmp_path):
    from rerun.chunk import RrdReader

    watched(steps[:5], tmp_path)
    for chunk in RrdReader(tmp_path / "out" / "v.rrd").stream().to_chunks():
        assert {*chunk.timeline_names} <= {"time"}


def test_of_each_camera_ten_pictures_a_second_are_shown(tmp_path):
    """A camera that brings 20 a second, and one that brings its own in between, of which one is missing."""
    second = PAIR.cameras[1].model.resolution
    other = np.zeros(second[::-1], np.uint8)

    def images(k):
        return (IMAGE, None) if k % 2 == 0 or k == 9 else (None, other)

    values, times = watched(made_up(41, images=lambda k: (IMAGE, None)), tmp_path / "a", PAIR)
    assert times[f"{AT}/body/cam0/image"] == [2 * k * PERIOD_NS for k in range(21)]
    assert f"{AT}/body/cam1/image" not in times
    values, times = watched(made_up(20, images=images), tmp_path / "b", PAIR)
    assert times[f"{AT}/body/cam0/image"] == [2 * k * PERIOD_NS for k in range(10)]
    assert times[f"{AT}/body/cam1/image"] == [k * PERIOD_NS for k in range(1, 20, 2) if k != 9]
    assert all(not row for row in values[f"{AT}/body/cam1/tracks", "Points2D:positions"])


def test_what_loop_closure_knows_is_shown_beside(tmp_path):
    correction = MapCorrection(so3.exp(np.array([0.0, 0.0, 0.7])), np.array([4.0, -3.0, 1.0]))
    values, _ = watched(made_up(30, correction=correction), tmp_path)
    at = r"/world/flight\ with\ loop\ closure"
    rows = values[f"{at}/path", "LineStrips3D:strips"] + values[rf"{at}/newest\ path", "LineStrips3D:strips"][-1:]
    strips = [strip for row in rows for strip in row]
    joined = np.concatenate([strips[0], *(strip[1:] for strip in strips[1:])])
    np.testing.assert_allclose(joined, flight(30).p_WB @ correction.R_MW.T + correction.p_MW, atol=1e-5)
    values, _ = watched(made_up(5, correction=MapCorrection()), tmp_path)
    assert not any("loop" in path for path, _ in values)


@pytest.fixture
def stuck(monkeypatch):
    """A viewer that takes nothing from the first picture on, until it is told to go on."""
    reached, go_on, jpeg = Event(), Event(), live_view.jpeg

    def stopped(*arguments):
        reached.set()
        assert go_on.wait(60.0)
        return jpeg(*arguments)

    monkeypatch.setattr(live_view, "jpeg", stopped)
    yield reached, go_on
    go_on.set()


def test_a_flight_does_not_wait_for_its_viewer(stuck, tmp_path, caplog):
    reached, go_on = stuck
    steps = made_up(61, images=lambda k: (IMAGE.copy(),))
    pictures = [weakref.ref(step.frames.images[0]) for step in steps]
    with LiveView("flight", CALIBRATION, tmp_path / "v.rrd") as view:
        view.add(steps[0])
        assert reached.wait(60.0)
        for step in steps[1:]:  # which would never end if it waited
            view.add(step)
        # Of those to be shown, every other, one is being shown and the newest four wait.
        assert view.left_out == 26
        del steps, step
        assert [k for k, picture in enumerate(pictures) if picture() is not None] == [0, 54, 56, 58, 60]
        go_on.set()
    assert "26 pictures were not shown" in caplog.text
    values, times = recorded(tmp_path / "v.rrd")
    assert times[f"{AT}/body/cam0/image"] == [k * PERIOD_NS for k in (0, 54, 56, 58, 60)]
    assert times[f"{AT}/body/cam0/tracks"] == times[f"{AT}/body/cam0/image"]
    assert times[f"{AT}/body"] == [k * PERIOD_NS for k in range(61)]
    assert len(values["/time/flight", "Scalars:scalars"]) == 61


def test_not_even_numbers_wait_without_bound(stuck, tmp_path):
    reached, go_on = stuck
    steps = made_up(700)
    with LiveView("flight", CALIBRATION, tmp_path / "v.rrd") as view:
        view.add(steps[0])
        assert reached.wait(60.0)
        for step in steps[1:]:
            view.add(step)
        go_on.set()
    _, times = recorded(tmp_path / "v.rrd")
    assert times[f"{AT}/body"] == [k * PERIOD_NS for k in (0, *range(200, 700))]


def test_a_viewer_that_hangs_is_left_alone(stuck, tmp_path, monkeypatch, caplog):
    import rerun as rr

    given_up = []
    monkeypatch.setattr(rr, "unregister_shutdown", lambda: given_up.append(True))
    monkeypatch.setattr(live_view, "_ENDS_WITHIN_S", 0.1)
    with LiveView("flight", CALIBRATION, tmp_path / "v.rrd") as view:
        view.add(made_up(1)[0])
        thread = view._thread
    assert "takes nothing any more" in caplog.text
    assert given_up
    stuck[1].set()
    thread.join(60.0)


def test_a_view_that_breaks_breaks_no_flight(tmp_path, monkeypatch, caplog):
    def broken(*_):
        raise ValueError("made up")

    monkeypatch.setattr(live_view, "jpeg", broken)
    with caplog.at_level(logging.WARNING), LiveView("flight", CALIBRATION, tmp_path / "v.rrd") as view:
        for step in made_up(30):
            view.add(step)
    assert caplog.text.count("no longer shown: made up") == 1


def test_nothing_that_is_sent_grows_with_the_flight(tmp_path):
    """Of the second half of a flight of 20 s, in which there always are new tracks, messages are as long as of the
    first."""
    values, times = watched(made_up(400), tmp_path)

    def longest(rows):
        return max((sum(map(np.size, row)) for row in rows if row), default=0)

    compared = set()
    for (path, name), rows in values.items():
        if len(rows) == len(times.get(path, ())) >= 20:
            stamped = [*zip(times[path], rows, strict=True)]
            early, late = ([row for t, row in stamped if (t >= 10 * NS_PER_S) == half] for half in (False, True))
            assert longest(late) <= 1.1 * longest(early), (path, name)
            compared.add(path)
    assert {f"{AT}/path", rf"{AT}/newest\ path", f"{AT}/landmarks", f"{AT}/body/cam0/tracks/tails"} <= compared


def test_what_is_missing_is_said_with_its_remedy(tmp_path, monkeypatch):
    with pytest.raises(RunError, match=r"no display.*--save-view FILE\.rrd"):
        LiveView("flight", CALIBRATION)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="cannot write"):
        LiveView("flight", CALIBRATION, tmp_path / "file" / "v.rrd")
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("DISPLAY", ":0")
        elsewhere.setenv("PATH", str(tmp_path))
        elsewhere.setattr("sys.executable", str(tmp_path / "python"))
        with pytest.raises(RunError, match=r"viewer does not start: .* --save-view FILE\.rrd") as raised:
            LiveView("flight", CALIBRATION)
        assert "\n" not in str(raised.value)
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    with pytest.raises(PluginError, match=r"pip install 'vioframe\[view\]'"):
        LiveView("flight", CALIBRATION, tmp_path / "v.rrd")
