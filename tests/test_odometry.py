"""The push interface: it gives the bytes of a recording played, and nothing grows while it runs."""

from __future__ import annotations

import gc
import json
import resource
import subprocess
import sys
import tracemalloc
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from click.testing import CliRunner
from plugin_helpers import install
from rendered_flight import CALIBRATION, RenderedFlight, rendered_flight

from vioframe import pipeline
from vioframe.cli import main
from vioframe.cores import limited_threads
from vioframe.errors import ConfigError, DatasetError, PluginError, RunError
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.frontend_process import FRAMES_AHEAD
from vioframe.geometry import so3
from vioframe.incidents import Incidents
from vioframe.io.calibration import load_calibration
from vioframe.io.memory import ArrayDataset
from vioframe.io.synchronise import synchronise
from vioframe.jit import heard
from vioframe.odometry import Odometry
from vioframe.parts import registry
from vioframe.runs.folder import RunFolder
from vioframe.runs.recorder import CALIBRATION_COLUMNS, Recorder
from vioframe.simulation import TrackOptions, simulated_stream
from vioframe.types import (
    NS_PER_S,
    Calibration,
    Estimate,
    FrameSet,
    FrameTracks,
    Image,
    ImuSample,
    ImuSegment,
    LoopClosure,
    MapCorrection,
    Measurement,
    Status,
    Step,
)
from vioframe_euroc import EurocDataset
from vioframe_msckf.backend import Msckf

BACKENDS = ("msckf", "sliding_window", "loose_ekf")
INSTALLED = registry.load()


def as_bytes(estimate: Estimate) -> bytes:
    """Everything in an estimate but the clock."""
    told = repr((estimate.status, estimate.events, estimate.is_keyframe)).encode()
    arrays = [estimate.landmark_ids, estimate.p_WF]
    if (state := estimate.state) is not None:
        arrays += [state.R_WB, state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B]
        arrays += [] if state.cov is None else [state.cov]
    if (learned := estimate.calibration) is not None:
        (camera,) = learned.calibration.cameras
        arrays += [camera.R_BC, camera.p_BC, np.array([camera.time_offset_ns]), learned.sigma[0].intrinsics]
    return told + b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)


def all_bytes(steps: Iterable[Step]) -> list[tuple[int, bytes, bytes]]:
    return [(s.frames.t_ns, s.tracks.ids.tobytes() + s.tracks.xy.tobytes(), as_bytes(s.estimate)) for s in steps]


def tracked(steps: list[Step]) -> int:
    return sum(step.estimate.status is Status.TRACKING for step in steps)


def pushed(odometry: Odometry, measurements: Iterable[Measurement], rng: np.random.Generator) -> Iterator[Step]:
    """The stream in pieces of any size, each sensor's own in order: now one runs ahead, now the other.

    The arrays are filled anew for every piece, as a driver's buffers are.
    """
    imu, frames = [], []
    for measurement in measurements:
        (imu if isinstance(measurement, ImuSample) else frames).append(measurement)
    image_buffer = np.empty_like(frames[0].images[0])
    buffer = np.empty((2, 200, 3))
    while imu or frames:
        if imu and (not frames or rng.random() < 0.5):
            count = int(rng.integers(1, 200))
            piece, imu = imu[:count], imu[count:]
            gyro_B, accel_B = buffer[:, : len(piece)]
            gyro_B[:], accel_B[:] = [s.gyro_B for s in piece], [s.accel_B for s in piece]
            if len(piece) == 1:
                yield from odometry.add_imu(piece[0].t_ns, gyro_B[0], accel_B[0])
            else:
                yield from odometry.add_imu([s.t_ns for s in piece], gyro_B, accel_B)
            continue
        for _ in range(int(rng.integers(1, 12))):
            if frames:
                frame = frames.pop(0)
                image_buffer[:] = frame.images[0]
                yield from odometry.add_images(frame.t_ns, image_buffer)
    yield from odometry.finish()


@cache
def short_flight() -> tuple[Measurement, ...]:
    """A second and a half at rest and three in flight."""
    whole: RenderedFlight = rendered_flight()
    return tuple(m for m in whole.measurements if m.t_ns < whole.measurements[0].t_ns + 4.6 * NS_PER_S)


def in_memory(measurements: Iterable[Measurement]) -> ArrayDataset:
    imu = [m for m in measurements if isinstance(m, ImuSample)]
    frames = [m for m in measurements if isinstance(m, FrameSet)]
    return ArrayDataset(
        CALIBRATION,
        [m.t_ns for m in imu],
        [m.gyro_B for m in imu],
        [m.accel_B for m in imu],
        [m.t_ns for m in frames],
        [m.images[0] for m in frames],
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_pieces_of_any_size_give_the_bytes_of_the_recording(backend):
    def odometry() -> Odometry:
        return Odometry(CALIBRATION, backend=backend, installed=INSTALLED)

    played = list(pipeline.run(in_memory(short_flight()), odometry()))
    assert len(played) == 46
    assert tracked(played) > 20
    expected = all_bytes(played)
    for seed in range(2):
        assert all_bytes(pushed(odometry(), short_flight(), np.random.default_rng(seed))) == expected


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_processes_give_the_bytes_of_one(backend: str):
    """At the start, in flight, and where it is lost and begins anew with another calibration."""
    measurements = short_flight()
    frames = [m.t_ns for m in measurements if isinstance(m, FrameSet)]

    def flown(pipelined: bool) -> list[Step]:
        odometry = Odometry(CALIBRATION, "shi_tomasi", backend, pipelined=pipelined, installed=INSTALLED)
        steps = []
        for step in odometry.follow(measurements):
            steps.append(step)
            if step.frames.t_ns == frames[len(frames) * 2 // 3]:
                lose(odometry)
        return steps

    def lose(odometry: Odometry) -> None:
        """The next frame finds the camera to be another one, and begins anew."""
        life, process = odometry._life, odometry._life.process

        def lost(imu: ImuSegment, tracks: FrameTracks, by: Calibration) -> Estimate:
            life.process = process
            process(imu, tracks, by)
            (camera,) = life.calibration.cameras
            initializer = life._initializer
            initializer._calibration = life.calibration.with_camera(
                0, model=camera.model.zoomed(1.01), time_offset_ns=camera.time_offset_ns + 3_000_000
            )
            life._following = False
            initializer.reset()
            return Estimate(Status.LOST, events=("lost",))

        life.process = lost

    alone, two = flown(False), flown(True)
    assert all_bytes(alone) == all_bytes(two)
    assert tracked(alone) > 10
    assert sum(step.estimate.status is Status.LOST for step in alone) == 1


def test_the_next_frames_are_begun_before_one_is_estimated():
    """While starting as in flight."""
    odometry = Odometry(CALIBRATION, "shi_tomasi", "msckf", pipelined=True, installed=INSTALLED)
    begun, ahead = 0, {Status.INITIALISING: [], Status.TRACKING: []}
    begin, life = odometry._frontend.begin, odometry._life
    process = life.process

    def counted(imu: ImuSegment, frames: FrameSet, calibration: Calibration) -> None:
        nonlocal begun
        begun += 1
        begin(imu, frames, calibration)

    def estimated(imu: ImuSegment, tracks: FrameTracks, by: Calibration) -> Estimate:
        estimate = process(imu, tracks, by)
        ahead[estimate.status].append(begun - sum(map(len, ahead.values())) - 1)
        return estimate

    odometry._frontend.begin, life.process = counted, estimated
    list(odometry.follow(short_flight()))
    starting, flying = ahead[Status.INITIALISING], ahead[Status.TRACKING]
    assert set(starting) == {FRAMES_AHEAD}
    assert flying == [FRAMES_AHEAD] * (len(flying) - FRAMES_AHEAD) + list(reversed(range(FRAMES_AHEAD)))
    assert begun == len(starting) + len(flying)


@pytest.mark.parametrize("pipelined", [False, True])
def test_what_came_before_a_source_failed_is_estimated(pipelined: bool):
    """Of 30 frames followed by 100 ms of readings all are there, also the one whose points the other thread had."""
    measurements = short_flight()
    end_ns = [m.t_ns for m in measurements if isinstance(m, FrameSet)][29] + NS_PER_S // 10

    def broken() -> Iterator[Measurement]:
        yield from (m for m in measurements if m.t_ns <= end_ns)
        raise DatasetError("cut off")

    steps: list[Step] = []
    with pytest.raises(DatasetError, match="cut off"):
        steps.extend(Odometry(CALIBRATION, pipelined=pipelined, installed=INSTALLED).follow(broken()))
    whole = list(Odometry(CALIBRATION, installed=INSTALLED).follow(measurements))
    assert len(steps) >= 30
    assert tracked(steps) > 10
    assert all_bytes(steps) == all_bytes(whole[: len(steps)])


# Detectors of a distribution of their own, as a process of its own finds them.
DETECTORS = """
import os
import numpy as np
from vioframe.types import Keypoints


class Never:
    def detect(self, image, max_points):
        raise ValueError("no")


class Talkative:
    def detect(self, image, max_points):
        print("looking", max_points)
        return Keypoints(np.float32([[20.0 + i, 20.0] for i in range(0, 40, 20)]), np.ones(2, np.float32))


class Deadly(Talkative):
    def detect(self, image, max_points):
        os._exit(3)


class Picky:
    def __init__(self):
        raise RuntimeError("not on a Tuesday")


@hookimpl
def vioframe_detectors():
    return {"never": Never, "talkative": Talkative, "deadly": Deadly, "picky": Picky}
"""


def apart(detector: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **options: object) -> Odometry:
    """With a detector of a distribution that is there only now, in a process of its own."""
    install(tmp_path, monkeypatch, distribution="odd-detectors", module="odd_detectors", code=DETECTORS)
    return Odometry(CALIBRATION, detector, pipelined=True, warm=False, **options)


def test_a_detector_that_fails_in_its_process_is_named(tmp_path, monkeypatch):
    with pytest.raises(PluginError, match="Never failed on each"):
        list(apart("never", tmp_path, monkeypatch).follow(short_flight()))


def test_a_name_that_two_give_is_that_of_the_one_asked_for(tmp_path, monkeypatch):
    code = DETECTORS.replace('"never"', '"orb"')
    install(tmp_path, monkeypatch, distribution="odd-detectors", module="odd_detectors", code=code)
    odometry = Odometry(CALIBRATION, "orb@odd-detectors", pipelined=True, warm=False)
    with pytest.raises(PluginError, match="Never failed on each"):
        list(odometry.follow(short_flight()))


def test_one_that_cannot_be_made_there_is_named(tmp_path, monkeypatch):
    with pytest.raises(PluginError, match=r"picky.*odd-detectors 1.0.*not on a Tuesday"):
        list(apart("picky", tmp_path, monkeypatch).follow(short_flight()))


def test_what_a_detector_prints_does_no_harm(tmp_path, monkeypatch, capfd):
    odometry = apart("talkative", tmp_path, monkeypatch)
    assert len(next(odometry.follow(short_flight())).tracks.ids) == 2
    out, err = capfd.readouterr()
    assert (out, err.splitlines()[0]) == ("", "looking 900")


def test_a_process_that_dies_is_an_error_with_a_remedy(tmp_path, monkeypatch):
    with pytest.raises(RunError, match=r"exit code 3.*--cores 1"):
        list(apart("deadly", tmp_path, monkeypatch).follow(short_flight()))


def test_incidents_of_the_other_process_are_counted(tmp_path, monkeypatch):
    incidents = Incidents()
    odometry = apart("never", tmp_path, monkeypatch, incidents=incidents)
    frames = [m for m in short_flight() if isinstance(m, FrameSet)]
    for frame in frames[:3]:
        odometry._frontend.track(ImuSegment(np.array([0]), np.zeros((1, 3)), np.zeros((1, 3))), frame, CALIBRATION)
    assert incidents.counts == {"detector_failed": 3}
    assert [note["t_ns"] for note in incidents.notes] == [frame.t_ns for frame in frames[:3]]


def test_an_image_of_another_size_is_refused_there_as_here():
    def refused(pipelined: bool) -> str:
        (frame, *_) = (m for m in short_flight() if isinstance(m, FrameSet))
        odometry = Odometry(CALIBRATION, pipelined=pipelined, warm=False, installed=INSTALLED)
        imu = ImuSegment(np.array([0]), np.zeros((1, 3)), np.zeros((1, 3)))
        with pytest.raises(DatasetError) as raised:
            odometry._frontend.track(imu, FrameSet(frame.t_ns, (frame.images[0][:-2],)), CALIBRATION)
        return str(raised.value)

    assert refused(True) == refused(False)


def test_what_the_other_process_compiles_is_told(tmp_path, monkeypatch):
    """Once: then it is there."""
    code = f"""
    import numpy as np
    from vioframe.jit import kernel
    from vioframe.types import Keypoints

    @kernel
    def never_seen_before(count):
        return {perf_counter()} + np.arange(count)

    class New:
        def detect(self, image, max_points):
            return Keypoints(20.0 + never_seen_before(4).astype(np.float32).reshape(2, 2) % 10, np.ones(2, np.float32))

    @hookimpl
    def vioframe_detectors():
        return {{"new": New}}
    """
    install(tmp_path, monkeypatch, distribution="new-detector", module="new_detector", code=code)
    for compiled in (["never_seen_before"], []):
        told: list[str] = []
        with heard(told.append):
            next(Odometry(CALIBRATION, "new", pipelined=True, warm=False).follow(short_flight()))
        assert told == compiled


def test_a_process_ends_with_who_made_it():
    odometry = Odometry(CALIBRATION, pipelined=True, warm=False, installed=INSTALLED)
    process = odometry._frontend._process
    following = odometry.follow(short_flight())
    next(following)
    assert process.poll() is None
    following.close()
    assert process.poll() is not None
    forgotten = Odometry(CALIBRATION, pipelined=True, warm=False, installed=INSTALLED)._frontend._process
    gc.collect()
    assert forgotten.poll() is not None


def test_a_detector_that_is_no_name_has_no_process():
    with pytest.raises(ConfigError, match="name an installed detector"):
        Odometry(CALIBRATION, INSTALLED.create_detector("fast"), pipelined=True, installed=INSTALLED)


def test_a_recording_from_files_is_the_same_pushed(shared_data):
    dataset = EurocDataset(shared_data / "euroc/MH_01_easy_15s", cameras="cam0")

    def odometry() -> Odometry:
        return Odometry(dataset.calibration, "fast", installed=INSTALLED)

    played = list(pipeline.run(dataset, odometry(), duration_s=4.0))
    assert tracked(played) > 20
    last_ns = played[-1].frames.t_ns
    part = [
        m
        for m in dataset.measurements()
        if m.t_ns <= last_ns or (isinstance(m, ImuSample) and m.t_ns <= last_ns + NS_PER_S)
    ]
    assert all_bytes(pushed(odometry(), part, np.random.default_rng(3))) == all_bytes(played)


def test_the_calibration_is_as_learned_by_now():
    odometry = Odometry(CALIBRATION, installed=INSTALLED)
    assert odometry.calibration is CALIBRATION
    steps = list(pipeline.run(in_memory(short_flight()), odometry))
    (camera,), (given,) = odometry.calibration.cameras, CALIBRATION.cameras
    assert 1e-6 < np.linalg.norm(so3.log(camera.R_BC.T @ given.R_BC)) < 0.02
    assert odometry.calibration is steps[-1].estimate.calibration.calibration
    assert odometry.calibration.imu == CALIBRATION.imu


def test_threads_are_few_while_it_runs_and_as_before_afterwards():
    """Also where one that began within another outlives it, as generators do."""
    import cv2
    from threadpoolctl import threadpool_info, threadpool_limits

    def blas() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    opencv = cv2.getNumThreads()
    with threadpool_limits(2, user_api="blas"):
        outer, inner = limited_threads(), limited_threads()
        for each in (outer, inner):
            each.__enter__()
            assert blas() == {1}
            assert cv2.getNumThreads() <= 4
        outer.__exit__(None, None, None)
        assert blas() == {1}
        inner.__exit__(None, None, None)
        assert (blas(), cv2.getNumThreads()) == ({2}, opencv)


# With a loop closer.


class Turning:
    """The map turns by a degree a frame, and moves by a metre."""

    def __init__(self) -> None:
        self.t_ns: list[int] = []

    def add(self, step: Step) -> MapCorrection:
        self.t_ns.append(step.frames.t_ns)
        return MapCorrection(so3.rotation_z(np.radians(len(self.t_ns))), np.array([0.0, 0.0, len(self.t_ns)]))

    def finish(self) -> LoopClosure:
        return LoopClosure(None, np.array(self.t_ns))


@pytest.mark.parametrize("pipelined", [False, True])
def test_steps_carry_the_correction_so_far_and_the_estimate_is_the_same(pipelined):
    with_it = Odometry(CALIBRATION, loop_closer=Turning(), pipelined=pipelined, installed=INSTALLED)
    without = Odometry(CALIBRATION, installed=INSTALLED)
    steps = list(pipeline.run(in_memory(short_flight()), with_it))
    assert [step.correction.p_MW[2] for step in steps] == list(range(1, len(steps) + 1))
    assert all(step.stage_seconds["loop_closure"] >= 0.0 for step in steps)
    assert with_it.close_loops().keyframe_t_ns.tolist() == [step.frames.t_ns for step in steps]
    alone = list(pipeline.run(in_memory(short_flight()), without))
    assert all_bytes(alone) == all_bytes(steps)
    assert all(step.correction is None and "loop_closure" not in step.stage_seconds for step in alone)
    assert without.close_loops() is None


def test_a_loop_closer_that_corrects_at_the_end_only_needs_no_more_than_before():
    class AtTheEnd(Turning):
        def add(self, step: Step) -> None:
            super().add(step)

    odometry = Odometry(CALIBRATION, loop_closer=AtTheEnd(), installed=INSTALLED)
    steps = [step for item in tracked_flight(2.0) for step in add(odometry, item)] + odometry.finish()
    assert len(steps) > 10
    assert all(step.correction is None for step in steps)
    assert odometry.close_loops().keyframe_t_ns.tolist() == [step.frames.t_ns for step in steps]


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        (np.eye(4), "it returned a ndarray, not a MapCorrection"),
        (MapCorrection(p_MW=np.zeros(2)), r"p_MW has the shape \(2,\), expected \(3,\)"),
        (MapCorrection(p_MW=np.full(3, np.nan)), "p_MW is not finite"),
        (MapCorrection(so3.exp(np.array([0.1, 0.0, 0.0]))), "R_MW is not a rotation about z"),
        (MapCorrection(np.diag([-1.0, 1.0, 1.0])), "R_MW is not a rotation about z"),
    ],
)
def test_a_correction_that_cannot_be_is_refused_by_name(returned, says):
    class Wrong(Turning):
        def add(self, step: Step) -> MapCorrection:
            return returned

    odometry = Odometry(CALIBRATION, loop_closer=Wrong(), installed=INSTALLED)
    with pytest.raises(PluginError, match=f"the loop closer Wrong at [0-9]+ ns: {says}; repair the plug-in"):
        [step for item in tracked_flight(2.0) for step in add(odometry, item)]


# What does not fit.


def test_two_cameras_are_refused_in_one_line_by_who_takes_one():
    camera = CALIBRATION.cameras[0]
    pair = replace(CALIBRATION, cameras=(camera, replace(camera, name="cam1")))

    class Single(Msckf):
        takes_rigs = False

    for backend in ("msckf", "sliding_window", "loose_ekf"):
        Odometry(pair, backend=backend, installed=INSTALLED)
    with pytest.raises(ConfigError) as refused:
        Odometry(pair, backend=Single(), installed=INSTALLED)
    assert "the back-end Single" in str(refused.value)
    assert "the calibration has cam0, cam1; choose one, as by --cameras cam0" in str(refused.value)
    assert "\n" not in str(refused.value)


IMAGE: Image = np.zeros((240, 376), np.uint8)


@pytest.mark.parametrize(
    ("push", "why"),
    [
        (lambda o: o.add_images(0, IMAGE, IMAGE), "2 images came for a rig of 1 camera"),
        (lambda o: o.add_images(0), "0 images came for a rig of 1 camera"),
        (lambda o: o.add_images(0, None), "1 images came for a rig of 1 camera"),
        (lambda o: o.add_imu([0, 1], np.zeros((2, 3)), np.zeros((1, 3))), "2 stamps came with 2 and 1 readings"),
        (lambda o: o.add_imu([0], np.zeros((2, 3)), np.zeros((2, 3))), "1 stamps came with 2 and 2 readings"),
    ],
)
def test_what_does_not_fit_together_is_refused(push, why):
    odometry = Odometry(CALIBRATION, installed=INSTALLED)
    with pytest.raises(DatasetError, match=why):
        push(odometry)


@pytest.mark.parametrize("wait_ms", [-1.0, float("nan")])
def test_a_wait_that_is_none_is_refused(wait_ms):
    with pytest.raises(ConfigError, match="wait_ms must be zero or more"):
        Odometry(CALIBRATION, wait_ms=wait_ms, installed=INSTALLED)


# Frames that somebody else has tracked.


@cache
def tracked_flight(duration_s: float = 6.0) -> tuple[ImuSample | FrameTracks, ...]:
    return tuple(simulated_stream("figure_eight", seed=1, duration_s=duration_s, calibration=CALIBRATION))


def add(odometry: Odometry, item: ImuSample | FrameTracks) -> list[Step]:
    return odometry.add_tracks(item) if isinstance(item, FrameTracks) else odometry.add(item)


@pytest.mark.parametrize("backend", BACKENDS)
def test_tracks_given_are_estimated_as_the_life_cycle_does(backend):
    items = tracked_flight()
    odometry = Odometry(CALIBRATION, backend=backend, installed=INSTALLED)
    steps = [step for item in items for step in add(odometry, item)] + odometry.finish()
    frames = {item.t_ns: item for item in items if isinstance(item, FrameTracks)}
    stream = (FrameSet(item.t_ns, ()) if isinstance(item, FrameTracks) else item for item in items)
    life = LifeCycle(INSTALLED.create_backend(backend), CALIBRATION)
    with limited_threads():
        alone = [life.process(imu, frames[frame.t_ns]) for imu, frame in synchronise(stream, Incidents())]
    assert tracked(steps) > 20
    assert [as_bytes(step.estimate) for step in steps] == [as_bytes(estimate) for estimate in alone]
    assert all(step.tracks is frames[step.frames.t_ns] for step in steps)


def test_of_frames_that_are_dropped_nothing_is_kept():
    odometry = Odometry(CALIBRATION, backend="msckf", installed=INSTALLED)
    items = tracked_flight()
    begin_ns, steps = items[0].t_ns, []
    for item in items:
        if isinstance(item, ImuSample) and item.t_ns < begin_ns + NS_PER_S:
            continue  # the frames of the first second have no readings
        steps += add(odometry, item)
        if isinstance(item, FrameTracks):
            steps += odometry.add_tracks(replace(item.only(item.ids < 0), t_ns=item.t_ns))  # a second of this stamp
            steps += odometry.add_tracks(replace(item, t_ns=item.t_ns - NS_PER_S))  # and one that is far too late
    steps += odometry.finish()
    assert len(odometry._waiting_tracks) <= 2
    assert odometry.incidents.counts["frame_duplicate"] > 90
    assert len(steps) == 101
    assert all(len(step.tracks.ids) for step in steps)


# What is learned of the calibration.


def test_the_learned_calibration_serves_the_next_run(tmp_path):
    bag, first, second = rendered_flight().write(tmp_path / "f.bag"), tmp_path / "first", tmp_path / "second"
    for out, more in ((first, []), (second, ["--calibration", str(first / "calibration_learned")])):
        done = CliRunner().invoke(main, ["run", str(bag), "--out", str(out), "--quiet", *more])
        assert done.exit_code == 0, done.output
    run = RunFolder.open(first)
    given, learned = run.calibration(), run.learned_calibration()
    assert given is not None
    assert learned is not None
    assert learned.imu == given.imu
    assert [camera.name for camera in learned.cameras] == [camera.name for camera in given.cameras]
    apart = so3.log(learned.cameras[0].R_BC.T @ given.cameras[0].R_BC)
    assert 1e-6 < np.linalg.norm(apart) < 0.02
    assert load_calibration(second / "calibration").cameras[0].model == learned.cameras[0].model
    assert RunFolder.open(second).summary["completion"] == 1.0
    table = np.genfromtxt(first / "calibration.csv", delimiter=",", names=True)
    assert table.dtype.names == CALIBRATION_COLUMNS
    assert len(table) == len(run.trajectory())
    assert (table["camera"] == 0).all()
    for column in ("sigma_rx", "sigma_ry", "sigma_rz", "sigma_time_offset_s"):
        assert table[column][-1] < table[column][0]
        assert (np.diff(table[column]) < 1e-6).all()
    assert table["fx"][-1] == pytest.approx(learned.cameras[0].model.fx, rel=1e-8)


# Nothing grows.


def fly_and_watch(backend: str, duration_s: float, folder: Path) -> Iterator[float]:
    """Fly to and fro with the recorder running; seconds flown, after each frame."""
    options = TrackOptions(max_points=100)
    stream = simulated_stream("figure_eight", options=options, duration_s=duration_s, calibration=CALIBRATION)
    odometry = Odometry(CALIBRATION, backend=backend, installed=INSTALLED)
    begin_ns = None
    with Recorder(folder, {}, odometry.incidents, perf_counter()) as recorder:
        for item in stream:
            for step in add(odometry, item):
                recorder.add(step)
                begin_ns = step.frames.t_ns if begin_ns is None else begin_ns
                yield (step.frames.t_ns - begin_ns) / NS_PER_S


@pytest.mark.slow
@pytest.mark.parametrize(
    "backend",
    ["sliding_window", *(pytest.param(name, marks=pytest.mark.very_slow) for name in ("msckf", "loose_ekf"))],
)
def test_no_object_is_kept_of_a_frame_that_is_done(backend, tmp_path):
    """Traced while it flies: what is alive in the last quarter is what was in the second, but for the map."""
    duration_s, alive = 12.0, []
    tracemalloc.start()
    try:
        for flown_s in fly_and_watch(backend, duration_s, tmp_path):
            if not len(alive) % 50:
                gc.collect()
            alive.append((flown_s, tracemalloc.get_traced_memory()[0]))
    finally:
        tracemalloc.stop()
    flown_s, size = np.array(alive).T
    early, late = (np.median(size[(flown_s > a) & (flown_s < b)]) for a, b in ((3.0, 6.0), (9.0, 12.0)))
    landmarks = len(RunFolder.open(tmp_path).landmarks())
    # Some 300 bytes a landmark in the map; the tracks of all frames alone would be more than that allows.
    assert late - early < 300_000 + 300 * landmarks


@pytest.mark.very_slow
@pytest.mark.parametrize("minutes", [60])
@pytest.mark.parametrize("backend", BACKENDS)
def test_an_hour_takes_no_more_memory_than_a_minute(backend, minutes, tmp_path):
    """By what the process ever took of the system: less than 50 MB after the first minute."""
    done = subprocess.run(
        [sys.executable, __file__, backend, str(60.0 * minutes + 1.0), str(tmp_path)], check=True, capture_output=True
    )
    after_minutes = json.loads(done.stdout)
    assert len(after_minutes) == minutes
    assert after_minutes[-1] - after_minutes[0] < 50.0
    summary = RunFolder.open(tmp_path).summary
    assert summary["finished"]
    assert summary["completion"] > 0.99


if __name__ == "__main__":
    megabytes: list[float] = []
    for flown_s in fly_and_watch(sys.argv[1], float(sys.argv[2]), Path(sys.argv[3])):
        if flown_s >= 60.0 * (len(megabytes) + 1):
            megabytes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    print(json.dumps(megabytes))
