"""What sensors and clocks do wrong in mid-flight: the flight survives it, the incident is counted under its name, and
the error is at most twice that of the clean flight.

A fault is planted at an instant in flight; ``s`` are seconds since then. The flight is a short one with rendered
images; where there is time, the same faults are planted in a real recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from faults.command_line import vioframe_
from vioframe.errors import DatasetError
from vioframe.evaluation import evaluate
from vioframe.odometry import Odometry
from vioframe.parts import registry
from vioframe.parts.config import parse
from vioframe.pipeline import Experiment, prepare, record
from vioframe.runs.folder import RunFolder
from vioframe.types import NS_PER_S, FrameSet, Image, ImuSample, Measurement

IMU, CAMERA = ImuSample, FrameSet
Timed = list[tuple[float, Measurement]]
"""Measurements, each with its ``s``."""
Disturbance = Callable[[Timed], list[Measurement]]


def each(kind: type, begin: float, end: float, change: Callable[[Measurement], list[Measurement]]) -> Disturbance:
    """``change`` applied to every measurement of ``kind`` within a time, the rest left as it is."""
    return lambda timed: [n for s, m in timed for n in (change(m) if isinstance(m, kind) and begin <= s < end else [m])]


def missing(kind: type, begin: float, end: float) -> Disturbance:
    return each(kind, begin, end, lambda m: [])


def twice(kind: type) -> Disturbance:
    return each(kind, 0.0, 1.0, lambda m: [m, m])


def reads(end: float, *, gyro: object = None, accel: object = None) -> Disturbance:
    """The readings on the axes that are given, None is as it was."""

    def change(m: ImuSample) -> list[Measurement]:
        values = (
            np.array([old if new is None else new for old, new in zip(own, given or [None] * 3, strict=True)], float)
            for own, given in ((m.gyro_B, gyro), (m.accel_B, accel))
        )
        return [ImuSample(m.t_ns, *values)]

    return each(IMU, 0.0, end, change)


def painted(end: float, paint: Callable[[Image], np.ndarray]) -> Disturbance:
    def change(m: FrameSet) -> list[Measurement]:
        image = np.array(paint(m.images[0]), np.uint8)
        image.flags.writeable = False
        return [FrameSet(m.t_ns, (image,))]

    return each(CAMERA, 0.0, end, change)


def stamped(kind: type, end: float, stamp: Callable[[int], int], *, also: bool = False) -> Disturbance:
    """Other stamps; ``also`` where the measurement comes with its own as well."""
    return each(kind, 0.0, end, lambda m: [replace(m, t_ns=stamp(m.t_ns)), *([m] if also else [])])


def everywhere(kind: type | tuple[type, ...], stamp: Callable[[int], int]) -> Disturbance:
    return lambda timed: [replace(m, t_ns=stamp(m.t_ns)) if isinstance(m, kind) else m for _, m in timed]


def frozen(kind: type, end: float) -> Disturbance:
    """The same again and again, each time with a new stamp."""

    def change(timed: Timed) -> list[Measurement]:
        first = next(m for s, m in timed if isinstance(m, kind) and s >= 0.0)
        return each(kind, 0.0, end, lambda m: [replace(first, t_ns=m.t_ns)])(timed)

    return change


def held_in_between(timed: Timed) -> list[Measurement]:
    """Of three readings of the accelerometer the first, thrice: it is slower, not stuck."""
    out: list[Measurement] = []
    place, accel = 0, np.zeros(3)
    for _, m in timed:
        if isinstance(m, IMU):
            accel = m.accel_B if place % 3 == 0 else accel
            m, place = ImuSample(m.t_ns, m.gyro_B, accel), place + 1
        out.append(m)
    return out


def shuffled(kind: type, group: int) -> Disturbance:
    """What comes within a second in groups, the order within each at random."""

    def change(timed: Timed) -> list[Measurement]:
        rng, out = np.random.default_rng(0), [m for _, m in timed]
        places = [i for i, (s, m) in enumerate(timed) if isinstance(m, kind) and 0.0 <= s < 1.0]
        for some in np.array(places[: len(places) // group * group]).reshape(-1, group):
            for place, m in zip(some, [out[i] for i in rng.permutation(some)], strict=True):
                out[place] = m
        return out

    return change


def held_up(timed: Timed) -> list[Measurement]:
    """A tenth of a second of readings arrives a second too late."""
    held = [m for s, m in timed if isinstance(m, IMU) and 0.0 <= s < 0.1]
    place = sum(s < 1.1 for s, _ in timed) - len(held)
    rest = missing(IMU, 0.0, 0.1)(timed)
    return rest[:place] + held + rest[place:]


def dropped_at_random(timed: Timed) -> list[Measurement]:
    rng = np.random.default_rng(0)
    return each(CAMERA, -2.0, 3.0, lambda m: [m] if rng.random() > 0.3 else [])(timed)


def noise(image: Image) -> np.ndarray:
    return np.random.default_rng(int(image.sum())).integers(0, 256, image.shape)


def torn(image: Image) -> np.ndarray:
    return np.where(np.arange(len(image))[:, None] < len(image) // 2, image, 0)


HOUR, JUMP = 3600 * NS_PER_S, 10 * NS_PER_S


@dataclass(frozen=True)
class Survived:
    """``incidents`` are all that must be counted, and how often; 0 is any number."""

    disturb: Disturbance
    incidents: dict[str, int]
    times: float = 2.0
    """By how much the error may exceed that of the clean flight."""
    resets: int = 0


# The readings alone lead on for so long, and where they led is not forgotten: of so short a flight it is much.
A_SECOND, THREE_SECONDS = 2.5, 8.0

SURVIVED = {
    # The IMU.
    "imu not a number": Survived(reads(0.1, gyro=[np.nan] * 3), {"imu_nan": 20, "imu_gap": 1}),
    "imu beyond any range": Survived(reads(0.005, gyro=[1e200] * 3, accel=[-1e200] * 3), {"imu_out_of_range": 1}),
    "gyroscope saturated": Survived(reads(0.05, gyro=[None, 34.9, None]), {"imu_saturated": 10, "imu_gap": 1}),
    "accelerometer saturated": Survived(reads(0.05, accel=[-156.9, None, None]), {"imu_saturated": 10, "imu_gap": 1}),
    "imu frozen": Survived(frozen(IMU, 0.2), {"imu_frozen": 40, "imu_gap": 1}),
    "accelerometer slower than the gyroscope": Survived(held_in_between, {}),
    "imu twice": Survived(twice(IMU), {"imu_duplicate": 200}),
    "imu out of order": Survived(shuffled(IMU, 4), {"imu_out_of_order": 0}),
    "imu a second late": Survived(held_up, {"imu_out_of_order": 20, "imu_gap": 1}),
    "imu gap of 0.05 s": Survived(missing(IMU, 0.0, 0.05), {"imu_gap": 1}),
    "imu gap of 0.3 s": Survived(missing(IMU, 0.0, 0.3), {"imu_gap": 1}, A_SECOND),
    "imu gap of 1 s": Survived(missing(IMU, 0.0, 1.0), {"imu_gap": 1}, resets=1),
    "imu falls silent": Survived(missing(IMU, 2.0, 99.0), {"frame_after_imu": 0}),
    # Too little of the rest is left: it begins in flight.
    "imu begins late": Survived(missing(IMU, -9.0, -4.7), {"frame_before_imu": 3}, times=6.0),
    "imu stamp from the future": Survived(stamped(IMU, 0.005, lambda t: t + HOUR), {"imu_out_of_order": 1}),
    # The camera.
    "images black": Survived(painted(1.0, np.zeros_like), {"featureless_image": 10}, A_SECOND),
    "images white": Survived(painted(1.0, lambda i: np.full_like(i, 255)), {"featureless_image": 10}, A_SECOND),
    "images noise": Survived(painted(1.0, noise), {}, A_SECOND),
    "images torn": Survived(painted(1.0, torn), {}),
    "images frozen": Survived(frozen(CAMERA, 1.0), {"frozen_image": 9}, A_SECOND),
    "images twice": Survived(twice(CAMERA), {"frame_duplicate": 10}),
    "images out of order": Survived(shuffled(CAMERA, 2), {"frame_out_of_order": 0}),
    "images dropped at random": Survived(dropped_at_random, {"camera_gap": 0}),
    "camera silent for 1 s": Survived(missing(CAMERA, 0.0, 1.0), {"camera_gap": 1}, A_SECOND),
    "camera blinded for 3 s": Survived(painted(3.0, np.zeros_like), {"featureless_image": 30}, THREE_SECONDS),
    "image stamp from the future": Survived(
        stamped(CAMERA, 0.1, lambda t: t + HOUR, also=True), {"frame_after_imu": 1, "frame_out_of_order": 1}
    ),
    "image stamp of 1970": Survived(stamped(CAMERA, 0.1, lambda t: 0), {"frame_out_of_order": 1}),
    # Both clocks.
    "clock set forward": Survived(
        stamped((IMU, CAMERA), 99.0, lambda t: t + JUMP), {"imu_gap": 1, "camera_gap": 1}, resets=1
    ),
}


class Recording:
    """The recording of an experiment, with other measurements."""

    def __init__(self, dataset: object, measurements: list[Measurement]) -> None:
        self._dataset, self._measurements = dataset, measurements

    def __getattr__(self, name: str) -> object:
        return getattr(self._dataset, name)

    def measurements(self) -> Iterator[Measurement]:
        return iter(self._measurements)


@dataclass(frozen=True)
class Clean:
    """A good recording, prepared, and its measurements, each with the seconds since the instant of the fault."""

    experiment: Experiment
    timed: Timed

    @classmethod
    def of(cls, path: Path, truth: Path | None, instant_s: float) -> Clean:
        tree = {"dataset": {"path": str(path)}, "ground_truth": truth and str(truth)}
        experiment = prepare(parse(tree), registry.load())
        measurements = list(experiment.dataset.measurements())
        instant_ns = measurements[0].t_ns + round(instant_s * NS_PER_S)
        return cls(experiment, [((m.t_ns - instant_ns) / NS_PER_S, m) for m in measurements])

    def fly(self, disturb: Disturbance, folder: Path) -> RunFolder:
        config, installed = self.experiment.config, self.experiment.registry
        # A back-end as an object is not warmed up by a flight of its own: that was done once.
        backend = installed.create_backend(config.backend.name)
        odometry = Odometry(self.experiment.dataset.calibration, config.detector.name, backend, installed=installed)
        dataset = Recording(self.experiment.dataset, disturb(self.timed))
        record(replace(self.experiment, dataset=dataset, odometry=odometry), folder)
        return RunFolder.open(folder)


def error_m(run: RunFolder) -> float:
    estimate, truth = run.trajectory(), run.ground_truth()
    assert estimate is not None
    assert truth is not None
    return evaluate(estimate, truth).ate_m.rmse


def as_it_was(timed: Timed) -> list[Measurement]:
    return [m for _, m in timed]


@pytest.fixture(scope="module")
def rendered(recordings: Path) -> Clean:
    """The body rests until 1.5 s; it is in flight until 9.5 s."""
    return Clean.of(recordings / "good.bag", recordings / "truth.tum", 5.0)


@pytest.fixture(scope="module")
def real(shared_data: Path) -> Clean:
    return Clean.of(shared_data / "euroc/MH_01_easy_15s", None, 8.0)


@pytest.fixture(scope="module")
def clean_m(recordings: Path) -> float:
    return error_m(RunFolder.open(recordings / "run"))


@pytest.fixture(scope="module")
def clean_real_m(real: Clean, tmp_path_factory: pytest.TempPathFactory) -> float:
    return error_m(real.fly(as_it_was, tmp_path_factory.mktemp("real") / "run"))


FAULTS = pytest.mark.parametrize("fault", SURVIVED.values(), ids=SURVIVED)


@FAULTS
def test_it_survives(rendered: Clean, clean_m: float, fault: Survived, tmp_path: Path) -> None:
    # Where it begins as ever, and is not lost, there is no need to wait until it goes on.
    until_s = 99.0 if fault.resets or fault.times > A_SECOND else 3.5
    short = replace(rendered, timed=[(s, m) for s, m in rendered.timed if s < until_s])
    counted = check(short, clean_m, fault, tmp_path / "run")
    assert counted.keys() == fault.incidents.keys()
    assert all(counted[kind] == count or not count for kind, count in fault.incidents.items()), counted


@pytest.mark.very_slow
@FAULTS
def test_it_survives_in_a_real_recording(real: Clean, clean_real_m: float, fault: Survived, tmp_path: Path) -> None:
    # At other rates the same fault is counted otherwise.
    assert check(real, clean_real_m, fault, tmp_path / "run").keys() >= fault.incidents.keys()


def check(clean: Clean, clean_m: float, fault: Survived, folder: Path) -> dict[str, int]:
    """That the flight survives the fault; the incidents that were counted."""
    run = clean.fly(fault.disturb, folder)
    estimate = run.trajectory()
    assert np.isfinite(estimate.p_WB).all()
    assert np.isfinite(estimate.R_WB).all()
    assert estimate.t_ns[-1] == run.summary["last_frame_t_ns"]  # tracking at the end
    assert run.summary["resets"] == fault.resets
    if fault.resets:
        assert any(event["event"].startswith("lost: ") for event in run.summary["events"])
    else:
        assert error_m(run) < fault.times * clean_m
    counted: dict[str, int] = run.summary["incidents"]
    return counted


def test_a_clock_set_back_ends_the_flight_there_and_what_came_after_is_counted(rendered, clean_m, tmp_path):
    run = rendered.fly(stamped((IMU, CAMERA), 99.0, lambda t: t - 5 * JUMP), tmp_path / "run")
    after = [m for s, m in rendered.timed if s >= 0.0]
    images = sum(isinstance(m, CAMERA) for m in after)
    # Readings that the last frames before still waited for found their place.
    counted = run.summary["incidents"]
    assert counted["frame_out_of_order"] == images
    assert len(after) - images - 30 < counted["imu_out_of_order"] <= len(after) - images
    assert error_m(run) < 2.0 * clean_m


# What no frame gets through: stamps that mean nothing.
REFUSED = {
    "image stamps all zero": (everywhere(CAMERA, lambda t: 0), r"stamps of the camera are 0"),
    "imu stamps all zero": (everywhere(IMU, lambda t: 0), r"stamps of the IMU are 0"),
    "imu clock ahead": (everywhere(IMU, lambda t: t + HOUR), r"camera and IMU overlap nowhere"),
    "imu clock behind": (everywhere(IMU, lambda t: t - 60 * NS_PER_S), r"camera and IMU overlap nowhere"),
}


@pytest.mark.parametrize(("disturb", "why"), REFUSED.values(), ids=REFUSED)
def test_it_is_refused(rendered, disturb, why, tmp_path):
    with pytest.raises(DatasetError, match=why):
        rendered.fly(disturb, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_was_survived_is_said(flight, here):
    begin_ns = flight.measurements[0].t_ns
    timed = [((m.t_ns - begin_ns) / NS_PER_S - 3.0, m) for m in flight.measurements]
    flight.write(Path("bad.bag"), reads(0.1, gyro=[np.nan] * 3)(timed))
    done = vioframe_("run", "bad.bag", "--out", "out", "--duration", 4)
    assert done.exit_code == 0
    assert "imu_gap 1, imu_nan 20" in done.stdout
    assert "warning" not in done.stderr.lower()
