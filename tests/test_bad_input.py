"""Bad input through the real command line: one line that says what to do, or a run that goes on and counts what it met.

The recordings are small flights with rendered pictures; :mod:`test_disturbances` does the like on a real one.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from plugin_helpers import install
from recordings import Message, image_message, imu_message, write_bag
from rendered_flight import DURATION_S, RenderedFlight, rendered_flight

from vioframe.cli import main
from vioframe.evaluation import evaluate
from vioframe.runs.folder import RunFolder
from vioframe.types import NS_PER_S, FrameSet, ImuSample, Measurement


def vioframe_(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)


def error_line(*arguments: object) -> str:
    """What a command that refuses says: one line, nothing else, exit code 2."""
    result = vioframe_(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("vioframe: error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr


@pytest.fixture(scope="module")
def flight() -> RenderedFlight:
    return rendered_flight()


@pytest.fixture(scope="module")
def recordings(flight: RenderedFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the flight as ``good.bag`` and as the ASL folder ``good``, its ground truth, and a run of it."""
    folder = tmp_path_factory.mktemp("recordings")
    flight.write(folder / "good.bag")
    flight.write(folder / "good")
    flight.write_ground_truth(folder / "truth.tum")
    done = vioframe_("run", folder / "good.bag", "--ground-truth", folder / "truth.tum", "--out", folder / "run")
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def here(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder from which the recordings are seen by their bare names."""
    for item in recordings.iterdir():
        (tmp_path / item.name).symlink_to(item)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# What is done to the working folder; each leaves ``bad.bag`` or ``bad`` in it, where it leaves anything.


def written(name: str, content: str | bytes) -> Callable[[RenderedFlight], None]:
    def write(flight: RenderedFlight) -> None:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())

    return write


def truncated(fraction: float) -> Callable[[RenderedFlight], None]:
    def truncate(flight: RenderedFlight) -> None:
        data = Path("good.bag").read_bytes()
        Path("bad.bag").write_bytes(data[: int(fraction * len(data))])

    return truncate


def unindexed(flight: RenderedFlight) -> None:
    """As a recorder that was killed leaves it: the header still says that there is no index."""
    data = bytearray(Path("good.bag").read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    Path("bad.bag").write_bytes(data)


def bag_of(*kinds: type, image: Callable[[np.ndarray], np.ndarray] = lambda image: image, encoding: str = "mono8"):
    def write(flight: RenderedFlight) -> None:
        messages: list[Message] = []
        for m in flight.measurements[:400]:
            if isinstance(m, ImuSample) and ImuSample in kinds:
                messages.append(imu_message("/imu0", m))
            elif isinstance(m, FrameSet) and FrameSet in kinds:
                messages.append(image_message("/cam0/image_raw", m.t_ns, image(m.images[0]), encoding))
        write_bag(Path("bad.bag"), messages)
        Path("bad.bag.calib").symlink_to("good.bag.calib")

    return write


def without_calibration(flight: RenderedFlight) -> None:
    Path("bad.bag").symlink_to(Path("good.bag").resolve())


def nothing(flight: RenderedFlight) -> None:
    pass


RUN_BAD = ("run", "bad.bag", "--out", "out")
RUN_GOOD = ("run", "good.bag", "--out", "out")
VICON = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n1,0,0,0,1,0,0,0\n"
)
LEICA = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n1,0,0,0\n"
ELSEWHEN = "".join(f"{9000 + 0.1 * k:.1f} {k} 0 0 0 0 0 1\n" for k in range(50))

REFUSED = {
    "missing file": (nothing, RUN_BAD, "bad.bag does not exist"),
    "empty file": (written("bad.bag", ""), RUN_BAD, "seems to be empty"),
    "not a bag": (written("bad.bag", "#ROSBAG? no\n" * 99), RUN_BAD, "run `rosbag reindex` on it or copy it again"),
    "bag cut in its header": (truncated(0.0005), RUN_BAD, "run `rosbag reindex` on it or copy it again"),
    "bag cut in half": (truncated(0.5), RUN_BAD, "run `rosbag reindex` on it or copy it again"),
    "bag without its index": (truncated(0.999), RUN_BAD, "run `rosbag reindex` on it or copy it again"),
    "unindexed bag": (unindexed, RUN_BAD, "not indexed"),
    "directory without mav0": (written("bad/notes.txt", "?"), ("run", "bad"), "bad is a folder without mav0/"),
    "empty mav0": (lambda _: Path("bad/mav0").mkdir(parents=True), ("run", "bad"), "no sensor is there; copy it again"),
    "no camera": (bag_of(ImuSample), RUN_BAD, "has no camera messages"),
    "no imu": (bag_of(FrameSet), RUN_BAD, "has no IMU messages"),
    "other image size": (
        bag_of(ImuSample, FrameSet, image=lambda i: i[::2, ::2]),
        RUN_BAD,
        "images of 188x120, but the calibration is for 376x240; name the right one",
    ),
    "16-bit images": (
        bag_of(ImuSample, FrameSet, image=lambda i: i.astype(np.uint16) << 4, encoding="mono16"),
        RUN_BAD,
        "has 16-bit images; say how many bits are in use, -o bit_depth",
    ),
    "float images": (
        bag_of(ImuSample, FrameSet, image=lambda i: i.astype(np.float32), encoding="32FC1"),
        RUN_BAD,
        "convert the images to mono8, rgb8 or bgr8",
    ),
    "no calibration": (without_calibration, RUN_BAD, "brings no calibration: --calibration FILE names one"),
    "calibration is not yaml": (
        written("c.yaml", "camera: [1, 2\n"),
        (*RUN_GOOD, "--calibration", "c.yaml"),
        "c.yaml is not valid YAML",
    ),
    "calibration is not text": (
        written("c.yaml", bytes(range(128, 256))),
        (*RUN_GOOD, "--calibration", "c.yaml"),
        "cannot read the calibration c.yaml: not a text file",
    ),
    "calibration of nothing": (
        written("c.yaml", "a: 1\n"),
        (*RUN_GOOD, "--calibration", "c.yaml"),
        "not a calibration of a known format (EuRoC, Kalibr, OpenVINS, VINS-Mono)",
    ),
    "unknown detector": (nothing, (*RUN_GOOD, "--detector", "shi_tomassi"), "did you mean 'shi_tomasi'?"),
    "unknown back-end": (nothing, (*RUN_GOOD, "--backend", "mskcf"), "did you mean 'msckf'?"),
    "unknown reader": (nothing, (*RUN_GOOD, "--reader", "rosbga"), "did you mean 'rosbag'?"),
    "wrong reader": (nothing, (*RUN_GOOD, "--reader", "euroc"), "an ASL data set is the folder that holds mav0/"),
    "unknown option": (nothing, (*RUN_GOOD, "-o", "max_clone=9"), "did you mean 'max_clones'?"),
    "unsuitable option": (nothing, (*RUN_GOOD, "-o", "max_clones=few"), "should be a valid integer"),
    "option out of range": (nothing, (*RUN_GOOD, "-o", "max_clones=1"), "should be greater than or equal to 3"),
    "unknown key": (
        written("c.yaml", "detectr: {name: orb}\n"),
        (*RUN_GOOD, "--config", "c.yaml"),
        "unknown key 'detectr' (did you mean 'detector'?)",
    ),
    "unknown key, checked": (
        written("c.yaml", "backend: {nmae: msckf}\n"),
        ("config", "--check", "c.yaml"),
        "unknown key 'backend.nmae' (did you mean 'name'?)",
    ),
    "nothing left to play": (nothing, (*RUN_GOOD, "--start", "100"), "of which --start and --duration leave none"),
    "vicon": (
        written("vicon0/data.csv", VICON),
        (*RUN_GOOD, "--ground-truth", "vicon0/data.csv"),
        "use state_groundtruth_estimate0/data.csv",
    ),
    "leica, renamed": (
        written("truth.csv", LEICA),
        (*RUN_GOOD, "--ground-truth", "truth.csv"),
        "use state_groundtruth_estimate0/data.csv",
    ),
    "empty ground truth": (
        written("truth.csv", ""),
        (*RUN_GOOD, "--ground-truth", "truth.csv"),
        "truth.csv: holds no poses; give a TUM or EuRoC trajectory",
    ),
    "another flight's ground truth": (
        written("truth2.tum", ELSEWHEN),
        ("evaluate", "run", "--ground-truth", "truth2.tum"),
        "are they of one flight and clock?",
    ),
    "another flight's ground truth, drawn": (
        written("truth2.tum", ELSEWHEN),
        ("plot", "run", "--ground-truth", "truth2.tum", "--out", "out"),
        "are they of one flight and clock?",
    ),
    "evaluation of no run": (written("bad/a", ""), ("evaluate", "bad"), "give what `vioframe run` wrote"),
    "evaluation of nothing": (nothing, ("evaluate", "bad"), "no such trajectory file; check the path"),
    "conversion of nothing": (nothing, ("convert", "bad", "out"), "bad does not exist"),
    "conversion of a broken bag": (truncated(0.5), ("convert", "bad.bag", "out"), "copy it again"),
    "conversion onto something": (nothing, ("convert", "good.bag", "good"), "remove it or choose another name"),
    "unknown part": (nothing, ("plugins", "obr"), "did you mean 'orb'?"),
}


@pytest.mark.parametrize(("spoil", "command", "says"), REFUSED.values(), ids=REFUSED.keys())
def test_what_cannot_be_done_is_refused_in_one_line(here, flight, spoil, command, says):
    spoil(flight)
    assert says in error_line(*command)
    assert not Path("out").exists()
    assert not Path("runs").exists()


def test_16_bit_images_are_read_once_their_depth_is_told(here, flight):
    bag_of(ImuSample, FrameSet, image=lambda i: i.astype(np.uint16) << 4, encoding="mono16")(flight)
    assert vioframe_(*RUN_BAD, "-o", "bit_depth=12", "--quiet").exit_code == 0
    assert RunFolder.open("out").trajectory() is not None


def test_images_that_change_their_size_end_the_run_and_keep_what_was_done(here, flight):
    images = iter(range(99))
    bag_of(ImuSample, FrameSet, image=lambda i: i if next(images) < 15 else i[::2, ::2])(flight)
    line = error_line(*RUN_BAD, "--quiet")
    assert "images of 188x120" in line
    assert "what was estimated until then is in out" in line
    assert len(RunFolder.open("out").trajectory()) == 5


def test_ground_truth_of_another_flight_does_not_spoil_a_run(here):
    Path("truth2.tum").write_text(ELSEWHEN)
    done = vioframe_(*RUN_GOOD, "--ground-truth", "truth2.tum", "--duration", 2)
    assert done.exit_code == 0
    assert "no comparison with the ground truth: no stamps in common" in done.stdout


# Disturbances in mid-flight, which lasts from 1.5 s to 9.5 s; before and after that the body rests.


def seconds(flight: RenderedFlight, m: Measurement) -> float:
    return (m.t_ns - flight.measurements[0].t_ns) / NS_PER_S


Disturbance = Callable[[RenderedFlight], list[Measurement]]


def each(change: Callable[[Measurement], list[Measurement]], kind: type, begin: float, end: float) -> Disturbance:
    """``change`` applied to every measurement of ``kind`` within a time, the rest left as it is."""

    def disturb(flight: RenderedFlight) -> list[Measurement]:
        out = []
        for m in flight.measurements:
            out += change(m) if isinstance(m, kind) and begin <= seconds(flight, m) < end else [m]
        return out

    return disturb


def without(kind: type, begin: float, end: float) -> Disturbance:
    return each(lambda m: [], kind, begin, end)


def painted(paint: Callable[[np.ndarray], np.ndarray]) -> Disturbance:
    return each(lambda m: [FrameSet(m.t_ns, (paint(m.images[0]),))], FrameSet, 5.0, 6.0)


def read(gyro_B: list[float], accel_B: list[float], end: float) -> Disturbance:
    faulty = np.array(gyro_B), np.array(accel_B)
    return each(lambda m: [ImuSample(m.t_ns, *faulty)], ImuSample, 5.0, end)


def shuffled(flight: RenderedFlight) -> list[Measurement]:
    """Readings in groups of four, the order within each at random."""
    rng, out = np.random.default_rng(0), list(flight.measurements)
    places = [i for i, m in enumerate(out) if isinstance(m, ImuSample) and 4.0 <= seconds(flight, m) < 6.0]
    for group in np.array(places[: len(places) // 4 * 4]).reshape(-1, 4):
        for place, m in zip(group, [out[i] for i in rng.permutation(group)], strict=True):
            out[place] = m
    return out


def held_up(flight: RenderedFlight) -> list[Measurement]:
    """A tenth of a second of readings arrives a second too late."""
    held = [m for m in flight.measurements if isinstance(m, ImuSample) and 5.0 <= seconds(flight, m) < 5.1]
    rest = without(ImuSample, 5.0, 5.1)(flight)
    place = next(i for i, m in enumerate(rest) if seconds(flight, m) >= 6.1)
    return rest[:place] + held + rest[place:]


# name: (disturbance, incidents it must leave, greatest error in m where the filter must not lose its way)
HANDLED: dict[str, tuple[Disturbance, dict[str, int], float | None]] = {
    "black images": (painted(np.zeros_like), {"featureless_image": 10}, 0.04),
    "saturated images": (painted(lambda i: np.full_like(i, 255)), {"featureless_image": 10}, 0.04),
    "noise for images": (
        painted(lambda i: np.random.default_rng(0).integers(0, 256, i.shape, dtype=np.uint8)),
        {},
        0.04,
    ),
    "camera gap of 0.5 s": (without(FrameSet, 5.0, 5.5), {"camera_gap": 1}, 0.03),
    "camera gap of 2 s": (without(FrameSet, 5.0, 7.0), {"camera_gap": 1}, 0.05),
    "imu gap of 0.3 s": (without(ImuSample, 5.0, 5.3), {"imu_gap": 1}, 0.05),
    "imu gap of 1 s": (without(ImuSample, 5.0, 6.0), {"imu_gap": 1}, None),
    "imu falls silent": (without(ImuSample, 8.0, 99.0), {"frame_after_imu": 36}, 0.03),
    "images before the imu": (without(ImuSample, -1.0, 0.3), {"frame_before_imu": 3}, 0.1),
    "imu not a number": (read([np.nan] * 3, [0.0, 0.0, 9.81], 5.1), {"imu_nan": 20, "imu_gap": 1}, 0.04),
    "imu far out of range": (read([1e200] * 3, [-1e200] * 3, 5.005), {"imu_out_of_range": 1}, 0.02),
    "imu twice": (each(lambda m: [m, m], ImuSample, 4.0, 6.0), {"imu_duplicate": 400}, 0.02),
    "images twice": (each(lambda m: [m, m], FrameSet, 4.0, 6.0), {"frame_duplicate": 20}, 0.02),
    "imu out of order": (shuffled, {"imu_out_of_order": 0}, 0.02),
    "imu a second late": (held_up, {"imu_out_of_order": 20, "imu_gap": 1}, 0.04),
}


@pytest.mark.parametrize(("disturb", "incidents", "error_m"), HANDLED.values(), ids=HANDLED.keys())
def test_what_is_irregular_is_handled_and_counted(here, flight, disturb, incidents, error_m):
    flight.write(Path("bad.bag"), disturb(flight))
    done = vioframe_(*RUN_BAD, "--ground-truth", "truth.tum")
    assert done.exit_code == 0, done.output
    assert "warning" not in done.stderr.lower()

    run = RunFolder.open("out")
    counted = run.summary["incidents"]
    assert counted.keys() == incidents.keys()
    assert all(counted[kind] == count or not count for kind, count in incidents.items()), counted
    assert all(f"{kind} {count}" in done.stdout for kind, count in counted.items())

    estimate = run.trajectory()
    assert np.isfinite(estimate.p_WB).all()
    assert np.isfinite(estimate.R_WB).all()
    assert estimate.t_ns[-1] == run.summary["last_frame_t_ns"]  # tracking at the end
    if error_m is None:
        assert run.summary["resets"] == 1
        assert any(event["event"].startswith("lost: no inertial readings") for event in run.summary["events"])
    else:
        assert run.summary["resets"] == 0
        assert evaluate(estimate, run.ground_truth()).ate_m.max < 3.0 * error_m
        assert evaluate(estimate, run.ground_truth()).ate_m.rmse < error_m


DETECTORS = """
import time
import numpy as np
from vioframe.types import Keypoints

def points(xy):
    return Keypoints(np.asarray(xy, np.float32), np.ones(len(xy), np.float32))

def raises(image, max_points):
    raise RuntimeError("no\\nmemory")

def exits(image, max_points):
    raise SystemExit(0)

BAD = {
    "nothing": lambda image, max_points: points(np.empty((0, 2))),
    "nan": lambda image, max_points: points(np.full((9, 2), np.nan)),
    "outside": lambda image, max_points: points(np.full((9, 2), -50.0)),
    "none": lambda image, max_points: None,
    "raises": raises,
    "exits": exits,
}

class Slow:
    def detect(self, image, max_points):
        import cv2
        time.sleep(0.05)
        return points(cv2.goodFeaturesToTrack(image, max_points, 0.01, 10)[:, 0])

def kind(bad):
    class Spoilt:
        "Shi-Tomasi for some calls, then what is bad."
        def __init__(self, *, good_calls: int = 0):
            self.good_calls = good_calls
        def detect(self, image, max_points):
            import cv2
            self.good_calls -= 1
            if self.good_calls < 0:
                return bad(image, max_points)
            return points(cv2.goodFeaturesToTrack(image, max_points, 0.01, 10)[:, 0])
    return Spoilt

class Mute:
    def begin(self, start): pass
    def process(self, imu, tracks, still): pass

@hookimpl
def vioframe_detectors(): return {"slow": Slow, **{name: kind(bad) for name, bad in BAD.items()}}
@hookimpl
def vioframe_backends(): return {"mute": Mute}
"""


@pytest.fixture
def spoilt_detectors(here, monkeypatch):
    install(here / "site", monkeypatch, distribution="spoilt", module="spoilt_detectors", code=DETECTORS)


INCIDENT = {
    "nothing": "detector_found_nothing",
    "nan": "detector_points_not_finite",
    "outside": "detector_points_outside",
    "none": "detector_failed",
    "raises": "detector_failed",
    "exits": "detector_failed",
}


@pytest.mark.parametrize(("detector", "incident"), INCIDENT.items())
def test_a_detector_that_goes_bad_is_counted_and_what_it_found_before_is_used(spoilt_detectors, detector, incident):
    command = ("--detector", detector, "-o", "good_calls=10", "--duration", 4, "--ground-truth", "truth.tum", "--quiet")
    assert vioframe_(*RUN_GOOD, *command).output == ""
    run = RunFolder.open("out")
    assert run.summary["incidents"][incident] > 10
    assert run.summary["completion"] == 1.0
    assert evaluate(run.trajectory(), run.ground_truth()).ate_m.rmse < 0.05


@pytest.mark.parametrize("detector", ["nothing", "nan", "outside"])
def test_a_detector_that_never_finds_a_point_gives_a_run_that_says_so(spoilt_detectors, detector):
    done = vioframe_(*RUN_GOOD, "--detector", detector, "--duration", 2)
    assert done.exit_code == 0
    assert "never initialised; the events in summary.json say why" in done.stdout
    assert f"{INCIDENT[detector]} 21" in done.stdout


@pytest.mark.parametrize(
    ("detector", "why"),
    [("none", "has no attribute 'xy'"), ("raises", "RuntimeError: no memory"), ("exits", "SystemExit: 0")],
)
def test_a_detector_that_never_works_ends_the_run(spoilt_detectors, detector, why):
    line = error_line(*RUN_GOOD, "--detector", detector, "--quiet")
    assert "failed on each of its first 10 calls" in line
    assert why in line
    assert "repair the plug-in or choose another detector" in line
    assert RunFolder.open("out").summary["incidents"] == {"detector_failed": 10}


def test_a_back_end_that_returns_nothing_is_an_error_of_the_plugin(spoilt_detectors):
    assert "returned a NoneType, not an Estimate; repair the plug-in" in error_line(
        *RUN_GOOD, "--backend", "mute", "--quiet"
    )


def vioframe_process(*arguments: object, **options) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "vioframe", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


def test_a_run_that_is_killed_can_be_evaluated_and_drawn(spoilt_detectors, here):
    slowly = ("--detector", "slow", "-o", "refill_below=1.0")
    environment = {**os.environ, "PYTHONPATH": str(here / "site")}
    process = vioframe_process(*RUN_GOOD, "--ground-truth", "truth.tum", "--quiet", *slowly, env=environment)
    trajectory = Path("out/trajectory.tum")
    while not (trajectory.is_file() and trajectory.read_text().count("\n") > 20):
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert json.loads(Path("out/summary.json").read_text())["finished"] is False

    evaluated = vioframe_("evaluate", "out", "--format", "json")
    assert evaluated.exit_code == 0, evaluated.output
    assert "the run was interrupted; these figures cover what it left" in evaluated.stderr
    drawn = vioframe_("plot", "out")
    assert drawn.exit_code == 0, drawn.output
    assert Path("out/plots/top_view.png").is_file()


def test_a_full_disk_is_one_line_and_keeps_what_was_written(here):
    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536))

    process = vioframe_process(*RUN_GOOD, "--quiet", preexec_fn=fill)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert stderr == "vioframe: error: cannot write to out: File too large; is the disk full?\n"
    run = RunFolder.open("out")
    assert run.summary["finished"] is False
    assert 0 < len(run.trajectory()) < 10 * DURATION_S


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("command", [("plugins",), ("evaluate", "run", "--format", "csv")])
def test_output_that_cannot_be_written_is_one_line(here, command):
    with Path("/dev/full").open("w") as full:
        process = vioframe_process(*command, stdout=full, env={**os.environ, "COLUMNS": "100"})
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert stderr == (
        "vioframe: error: cannot read or write the output: No space left on device; check permissions and free space\n"
    )


def test_an_evaluation_that_cannot_be_kept_is_still_shown(here, monkeypatch):
    def refuse(path: Path, tree: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("vioframe.runs.recorder.write_json", refuse)
    result = vioframe_("evaluate", "run", "--format", "csv")
    assert result.exit_code == 2
    assert result.stdout.count("\n") >= 2
    assert "cannot read or write run/evaluation.json: Permission denied" in result.stderr


def test_a_reader_that_closes_the_pipe_early_is_no_error(here):
    process = vioframe_process("evaluate", "run", stdout=subprocess.PIPE)
    process.stdout.close()
    assert "Traceback" not in process.communicate(timeout=60)[1]
