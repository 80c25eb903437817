"""Files that are missing, broken, foreign or hostile, through the real command line.

There comes one line that says what to do, or a run that goes on and counts what it met.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from shutil import copy

import numpy as np
import pytest
from recordings import Message, image_message, imu_message, write_bag
from rendered_flight import RenderedFlight

from faults.command_line import error_line, vioframe_
from vioframe.runs.folder import RunFolder
from vioframe.types import FrameSet, ImuSample

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


def asl(change: Callable[[Path], object]) -> Callable[[RenderedFlight], None]:
    """The ASL folder ``bad``, and what ``change`` makes of its ``mav0``."""

    def spoil(flight: RenderedFlight) -> None:
        for file in Path("good/mav0").glob("[ci]*0/**/*"):
            there = Path("bad", file.relative_to("good"))
            there.parent.mkdir(parents=True, exist_ok=True)
            if file.suffix == ".png":
                there.symlink_to(file.resolve())
            elif file.is_file():
                copy(file, there)
        change(Path("bad/mav0"))

    return spoil


def edited(name: str, old: str, new: str) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return edit


def table(sensor: str, content: str | None) -> Callable[[RenderedFlight], None]:
    """With another table, or with none."""

    def change(mav0: Path) -> None:
        (mav0 / sensor / "data.csv").unlink()
        if content is not None:
            (mav0 / sensor / "data.csv").write_text(content)

    return asl(change)


def made(make: Callable[[Path], object], name: str) -> Callable[[RenderedFlight], None]:
    def spoil(flight: RenderedFlight) -> None:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        make(Path(name))

    return spoil


def in_a_circle(path: Path) -> None:
    path.symlink_to(path.absolute())


RUN_BAD = ("run", "bad.bag", "--out", "out")
RUN_GOOD = ("run", "good.bag", "--out", "out")
RUN_ASL = ("run", "bad", "--out", "out")
CAMERA_YAML, IMU_YAML = "cam0/sensor.yaml", "imu0/sensor.yaml"
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
        "not a calibration of a known format (EuRoC, Kalibr, OpenVINS, VINS-Mono, the main file of VINS-Fusion",
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
    "bag is a folder": (made(Path.mkdir, "bad.bag"), RUN_BAD, "bad.bag is an empty folder"),
    "bag is a pipe": (made(os.mkfifo, "bad.bag"), RUN_BAD, "bad.bag is no ordinary file"),
    "bag in a circle of links": (made(in_a_circle, "bad.bag"), RUN_BAD, "bad.bag does not exist"),
    "imu table missing": (table("imu0", None), RUN_ASL, "imu0/data.csv is missing; choose"),
    "imu table empty": (table("imu0", ""), RUN_ASL, "imu0/data.csv holds no sample; the recording has no IMU data"),
    "imu table a heading": (table("imu0", "#timestamp\n"), RUN_ASL, "imu0/data.csv holds no sample"),
    "imu table of words": (table("imu0", "a,b\nc,d\n"), RUN_ASL, "imu0/data.csv holds no sample"),
    "image table empty": (table("cam0", ""), RUN_ASL, "cam0/data.csv lists no image"),
    "image table a heading": (table("cam0", "#timestamp,filename\n"), RUN_ASL, "cam0/data.csv lists no image"),
    "image table in seconds": (table("cam0", "1.5,a.png\n2.5,b.png\n"), RUN_ASL, "a stamp in integer nanoseconds"),
    "image table a pipe": (
        asl(lambda mav0: ((mav0 / "cam0/data.csv").unlink(), os.mkfifo(mav0 / "cam0/data.csv"))),
        RUN_ASL,
        "cam0/data.csv is no ordinary file",
    ),
    "calibration missing": (
        asl(lambda mav0: (mav0 / CAMERA_YAML).unlink()),
        RUN_ASL,
        "cannot read the calibration",
    ),
    "calibration with focal length zero": (
        asl(edited(CAMERA_YAML, "intrinsics: [229.0", "intrinsics: [0.0")),
        RUN_ASL,
        "sensor.yaml: camera needs fx, fy > 0",
    ),
    "calibration with NaN": (
        asl(edited(CAMERA_YAML, "intrinsics: [229.0", "intrinsics: [.nan")),
        RUN_ASL,
        "'intrinsics' should be 4 or 6 finite numbers",
    ),
    "calibration without rotation": (
        asl(edited(CAMERA_YAML, "data: [", "data: [9")),
        RUN_ASL,
        "'T_BS' holds no rotation: its rows are not orthonormal and right-handed",
    ),
    "calibration with a misspelt key": (
        asl(edited(CAMERA_YAML, "intrinsics:", "intrinsic:")),
        RUN_ASL,
        "sensor.yaml: 'intrinsics' is missing",
    ),
    "calibration without resolution": (
        asl(edited(CAMERA_YAML, "resolution: [376, 240]", "resolution: [0, -1]")),
        RUN_ASL,
        "camera needs a resolution of (width, height) px, got (0, -1)",
    ),
    "calibration of a noiseless imu": (
        asl(edited(IMU_YAML, "gyroscope_noise_density: ", "gyroscope_noise_density: 0 # ")),
        RUN_ASL,
        "'gyroscope_noise_density' should be greater than 0, not 0",
    ),
    "calibration from nowhere": (nothing, (*RUN_GOOD, "--calibration", "c.yaml"), "c.yaml: No such file"),
    "calibration folder with a pipe": (
        made(os.mkfifo, "c/c.yaml"),
        (*RUN_GOOD, "--calibration", "c"),
        "there is no calibration file",
    ),
    "calibration in a circle of links": (
        made(in_a_circle, "c.yaml"),
        (*RUN_GOOD, "--calibration", "c.yaml"),
        "Too many levels of symbolic links",
    ),
    "configuration is a folder": (nothing, (*RUN_GOOD, "--config", "good"), "configuration good: Is a directory"),
    "ground truth with a word in it": (
        written("truth2.tum", "1 0 0 0 0 0 0 1\n2 0 0 zero 0 0 0 1\n"),
        (*RUN_GOOD, "--ground-truth", "truth2.tum"),
        "truth2.tum, line 2: the pose is not finite: 0 0 zero 0 0 0 1",
    ),
    "ground truth packed and cut": (
        written("truth2.tum.gz", b"\x1f\x8b\x08\0\0\0\0\0\0\xff"),
        (*RUN_GOOD, "--ground-truth", "truth2.tum.gz"),
        "truth2.tum.gz: cannot be read",
    ),
    "run folder is a file": (nothing, ("run", "good.bag", "--out", "truth.tum"), "truth.tum exists already"),
    "run folder of somebody's": (
        written("mine/thesis.tex", ""),
        ("run", "good.bag", "--out", "mine", "--overwrite"),
        "mine holds no summary.json, is not a run folder and is not overwritten",
    ),
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


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
@pytest.mark.parametrize("name", ["bad.bag", "c.yaml", "truth2.tum"])
def test_what_may_not_be_read_is_named(here, name):
    Path(name).touch(mode=0)
    options = {"c.yaml": ("--calibration", name), "truth2.tum": ("--ground-truth", name)}
    assert "Permission denied" in error_line("run", name if name == "bad.bag" else "good.bag", *options.get(name, ()))


def image(number: int, change: Callable[[Path, bytes], object]) -> Callable[[RenderedFlight], None]:
    """Something else in the place of one image file."""

    def spoil(mav0: Path) -> None:
        file = sorted((mav0 / "cam0/data").iterdir())[number]
        data = file.read_bytes()
        file.unlink()
        change(file, data)

    return asl(spoil)


def named(name: str) -> Callable[[RenderedFlight], None]:
    """Another name for an image in the table."""

    def change(mav0: Path) -> None:
        rows = (mav0 / "cam0/data.csv").read_text().splitlines()
        rows[8] = f"{rows[8].partition(',')[0]},{name}"
        (mav0 / "cam0/data.csv").write_text("\n".join(rows))

    return asl(change)


def colour(image: np.ndarray) -> np.ndarray:
    return np.repeat(image[:, :, None], 3, axis=2)


SURVIVED = {
    "image of the folder above": (named("../../secret.png"), {"frame_unreadable": 1}),
    "image of somewhere else": (named("/etc/passwd"), {"frame_unreadable": 1}),
    "image missing": (image(8, lambda file, data: None), {"frame_unreadable": 1}),
    "image cut in half": (
        image(8, lambda file, data: file.write_bytes(data[: len(data) // 2])),
        {"frame_unreadable": 1},
    ),
    "image of no byte": (image(8, lambda file, data: file.touch()), {"frame_unreadable": 1}),
    "image of text": (image(8, lambda file, data: file.write_text("GIF89a")), {"frame_unreadable": 1}),
    "image is a folder": (image(8, lambda file, data: file.mkdir()), {"frame_unreadable": 1}),
    "image is a pipe": (image(8, lambda file, data: os.mkfifo(file)), {"frame_unreadable": 1}),
    "image in a circle of links": (image(8, lambda file, data: in_a_circle(file)), {"frame_unreadable": 1}),
    "reading of words": (asl(edited("imu0/data.csv", "\n", "\na,b,c,d,e,f,g\n")), {"imu_unreadable": 1}),
    "reading cut off": (asl(edited("imu0/data.csv", "\n", "\n1,2,3\n")), {"imu_unreadable": 1}),
    "colour images": (bag_of(ImuSample, FrameSet, image=colour, encoding="bgr8"), {}),
}


@pytest.mark.parametrize(("spoil", "incidents"), SURVIVED.values(), ids=SURVIVED)
def test_what_can_be_passed_over_is_counted(here, flight, spoil, incidents):
    spoil(flight)
    done = vioframe_("run", "bad" if Path("bad").exists() else "bad.bag", "--out", "out", "--duration", 1.8)
    assert done.exit_code == 0, done.output
    summary = RunFolder.open("out").summary
    assert summary["incidents"] == incidents
    assert summary["completion"] == 1.0
    assert summary["frames"] == 19 - incidents.get("frame_unreadable", 0)
