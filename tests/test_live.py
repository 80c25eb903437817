"""Live sources: what waits, what gives way, what is recorded, how late it is, and what readings lead on."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from click.testing import CliRunner
from plugin_helpers import install
from rendered_flight import CALIBRATION, rendered_flight

from vioframe.cli import main
from vioframe.errors import DatasetError, SourceError
from vioframe.estimation.inertial.preintegration import preintegrate
from vioframe.geometry import so3
from vioframe.incidents import Incidents
from vioframe.io.synchronise import synchronise
from vioframe.live import Live, stream
from vioframe.live.ahead import Ahead
from vioframe.live.inbox import Inbox
from vioframe.live.latency import HostClock, Latencies
from vioframe.live.tape import Tape
from vioframe.parts import registry
from vioframe.runs.folder import RunFolder
from vioframe.simulation import simulated_sequence
from vioframe.testing import check_source
from vioframe.types import (
    NS_PER_S,
    Calibration,
    Estimate,
    FrameSet,
    FrameTracks,
    ImuSample,
    Measurement,
    NavState,
    Status,
    Step,
    Unreadable,
)
from vioframe_replay import Replay

INSTALLED = registry.load()
MS = 1_000_000


def reading(t_ns: int) -> ImuSample:
    return ImuSample(t_ns, np.zeros(3), np.array([0.0, 0.0, 9.81]))


def frame(t_ns: int) -> FrameSet:
    return FrameSet(t_ns, (np.full((8, 8), t_ns % 251, np.uint8),))


def stamps(measurements: Iterable[Measurement]) -> list[tuple[str, int]]:
    return [(type(m).__name__, m.t_ns) for m in measurements]


class Scripted:
    """Brings what it was told, attempt by attempt; an attempt that is an error is raised."""

    name, frame_count, ground_truth = "scripted", None, None

    def __init__(self, *attempts: Iterable[Measurement | Exception], calibration: Calibration = CALIBRATION) -> None:
        self._attempts = [iter(attempt) for attempt in attempts]
        self.calibration = calibration
        self.closed = Event()
        self.told: list[NavState] = []

    def measurements(self) -> Iterator[Measurement]:
        for item in self._attempts.pop(0) if self._attempts else ():
            if isinstance(item, Exception):
                raise item
            if self.closed.is_set():
                return
            yield item

    def tell(self, state: NavState) -> None:
        self.told.append(state)

    def close(self) -> None:
        self.closed.set()


def live(source: Scripted) -> Live:
    return Live(source, Ahead(CALIBRATION.imu))


class TestInbox:
    def test_order_is_kept_and_of_frames_the_oldest_gives_way(self):
        inbox = Inbox(most_frames=2)
        for measurement in (frame(1), reading(2), frame(3), reading(4), frame(5), reading(6)):
            inbox.put(measurement)
        inbox.end()
        kept = list(inbox)
        assert stamps(kept) == [
            *(("Unreadable", 1), ("ImuSample", 2), ("FrameSet", 3)),
            *(("ImuSample", 4), ("FrameSet", 5), ("ImuSample", 6)),
        ]
        assert isinstance(kept[0], Unreadable)
        assert kept[0].kind == "frame_dropped"
        assert inbox.dropped == 1

    def test_one_that_was_taken_makes_room(self):
        inbox = Inbox(most_frames=1)
        items = iter(inbox)
        for t_ns in range(1, 5):
            inbox.put(frame(t_ns))
            assert next(items).t_ns == t_ns
        assert inbox.dropped == 0

    def test_readings_never_give_way(self):
        inbox = Inbox(most_frames=1)
        for t_ns in range(5000):
            inbox.put(reading(t_ns))
            inbox.put(frame(t_ns))
        inbox.end()
        kept = list(inbox)
        assert sum(isinstance(m, ImuSample) for m in kept) == 5000
        assert sum(isinstance(m, FrameSet) for m in kept) == 1
        assert inbox.dropped == 4999

    def test_an_error_comes_behind_what_came_before_it(self):
        inbox = Inbox(most_frames=1)
        inbox.put(reading(1))
        inbox.end(SourceError("gone"))
        inbox.put(reading(2))  # too late
        items = iter(inbox)
        assert next(items).t_ns == 1
        with pytest.raises(SourceError, match="gone"):
            next(items)


class TestLatency:
    def test_another_clock_is_told_by_what_came_quickest(self):
        clock, apart_ns = HostClock(), 123_456_789_000
        rng = np.random.default_rng(0)
        for k in range(2000):
            t_ns = k * 5 * MS
            clock.heard(t_ns, t_ns + apart_ns + round(rng.exponential(3 * MS)))
        assert clock.since_s(t_ns, t_ns + apart_ns + 40 * MS) == pytest.approx(0.040, abs=1e-4)

    @pytest.mark.parametrize("drift", [50e-6, -50e-6])
    def test_clocks_that_drift_apart_are_compared_anew(self, drift: float):
        clock = HostClock()
        for k in range(60_000):  # five minutes: 15 ms apart by then
            t_ns = k * 5 * MS
            clock.heard(t_ns, round(t_ns * (1.0 + drift)))
        assert clock.since_s(t_ns, round(t_ns * (1.0 + drift))) == pytest.approx(0.0, abs=6e-4)

    def test_figures(self):
        latencies = Latencies()
        assert latencies.figures_ms() is None
        assert latencies.last_s is None
        for k in range(101):
            latencies.add(1e-3 * k)
        assert latencies.figures_ms() == pytest.approx({"median": 50.0, "p99": 99.0, "longest": 100.0})
        assert latencies.last_s == 0.1


class TestAhead:
    NOISE = CALIBRATION.imu

    @staticmethod
    def flight() -> tuple[list[ImuSample], list[NavState]]:
        """Readings without noise, and where the body truly is at each frame."""
        sequence = simulated_sequence("figure_eight", noise=None, duration_s=3.0)
        samples = [m for m in sequence.measurements() if isinstance(m, ImuSample)]
        cov = np.diag(np.repeat([1e-3, 1e-2, 1e-2, 1e-4, 1e-2], 3) ** 2)
        return samples, [replace(state, cov=cov) for state in sequence.true_states]

    def test_readings_lead_on_to_where_the_body_is(self):
        samples, true = self.flight()
        ahead, start = Ahead(self.NOISE, rate_hz=1000.0), true[20]
        told = []
        for sample in samples:
            if sample.t_ns >= start.t_ns + 60 * MS and not told:  # the estimate comes late
                ahead.corrected(start, 0)
            if (state := ahead.read(sample)) is not None:
                told.append(state)
        after = {state.t_ns: state for state in told}
        both = [(after[t.t_ns], t) for t in true if t.t_ns in after and t.t_ns < start.t_ns + 0.9 * NS_PER_S]
        assert len(both) >= 10
        for state, truth in both:
            assert np.linalg.norm(state.p_WB - truth.p_WB) < 2e-3
            assert np.linalg.norm(so3.log(state.R_WB.T @ truth.R_WB)) < 1e-3
        assert told[0].t_ns - start.t_ns >= 60 * MS

    def test_a_chain_of_readings_is_one_integration(self):
        samples, true = self.flight()
        start = true[20]
        ahead = Ahead(self.NOISE, rate_hz=1000.0)
        ahead.corrected(start, 0)
        told = [
            state for sample in samples if sample.t_ns <= start.t_ns + 0.2 * NS_PER_S and (state := ahead.read(sample))
        ]
        measured: list[Measurement] = [*samples, *(FrameSet(t, (None,)) for t in (start.t_ns, told[-1].t_ns))]
        (_, _), (imu, _) = synchronise(measured, Incidents())
        whole = preintegrate(imu, start.bias_gyro_B, start.bias_accel_B, self.NOISE).predict(start)
        np.testing.assert_allclose(told[-1].p_WB, whole.p_WB, atol=1e-5)
        np.testing.assert_allclose(told[-1].cov, whole.cov, rtol=0.02, atol=1e-12)
        variances = [np.trace(state.cov[3:6, 3:6]) for state in told]
        assert np.all(np.diff(variances) > 0.0)

    def test_readings_are_of_another_clock(self):
        samples, true = self.flight()
        offset_ns, start = 20 * MS, true[20]
        ahead = Ahead(self.NOISE, rate_hz=1000.0)
        ahead.corrected(start, offset_ns)
        late = [replace(sample, t_ns=sample.t_ns + offset_ns) for sample in samples]
        told = {state.t_ns: state for sample in late if (state := ahead.read(sample)) is not None}
        (truth,) = [state for state in true if state.t_ns == start.t_ns + 100 * MS]
        assert np.linalg.norm(told[truth.t_ns].p_WB - truth.p_WB) < 1e-4

    def test_no_more_often_than_asked(self):
        samples, true = self.flight()
        ahead = Ahead(self.NOISE, rate_hz=50.0)
        ahead.corrected(true[20], 0)
        told = [state.t_ns for sample in samples if (state := ahead.read(sample)) is not None]
        assert np.diff(told).min() >= 15 * MS
        assert np.diff(told).max() <= 20 * MS

    def test_no_estimate_no_state_and_none_of_long_ago(self):
        samples, true = self.flight()
        ahead = Ahead(self.NOISE)
        assert not any(ahead.read(sample) for sample in samples[:100])
        ahead.corrected(true[20], 0)
        told = [state.t_ns for sample in samples[100:] if (state := ahead.read(sample)) is not None]
        assert told[-1] <= true[20].t_ns + 1.01 * NS_PER_S
        ahead.corrected(None, 0)
        assert ahead.read(replace(samples[-1], t_ns=samples[-1].t_ns + 5 * MS)) is None

    def test_the_next_estimate_takes_over(self):
        samples, true = self.flight()
        ahead = Ahead(self.NOISE, rate_hz=1000.0)
        first, second = true[20], replace(true[24], p_WB=true[24].p_WB + np.array([1.0, 0.0, 0.0]))
        jumps = []
        for sample in samples:
            if sample.t_ns == first.t_ns:
                ahead.corrected(first, 0)
            if sample.t_ns == second.t_ns + 50 * MS:
                ahead.corrected(second, 0)
            if (state := ahead.read(sample)) is not None:
                jumps.append(state.p_WB[0])
        assert 0.9 < np.abs(np.diff(jumps)).max() < 1.1


class TestTape:
    def test_what_was_taken_is_read_in_its_order(self, tmp_path: Path):
        """Also a reading that came behind a frame that it belongs ahead of."""
        given: list[Measurement] = [
            reading(10 * MS),
            frame(20 * MS),
            reading(15 * MS),
            reading(25 * MS),
            frame(24 * MS),
        ]
        with Tape(tmp_path / "flight.mcap", small()) as tape:
            for measurement in given:
                tape.add(measurement)
        assert stamps(INSTALLED.open_dataset(tmp_path / "flight.mcap").measurements()) == stamps(given)

    def test_it_is_complete_however_the_flight_ends(self, tmp_path: Path):
        given = [reading(10 * MS), frame(20 * MS)]
        with pytest.raises(KeyboardInterrupt):
            self.take(tmp_path / "flight.mcap", [*given, KeyboardInterrupt()])
        assert len(stamps(INSTALLED.open_dataset(tmp_path / "flight.mcap").measurements())) == 2

    @pytest.mark.parametrize(
        ("name", "why"),
        [("folder", "record to .*folder.mcap instead"), ("a.txt", "tells no format"), ("there.mcap", "exists already")],
    )
    def test_what_cannot_be_written_is_refused_ahead_of_the_flight(self, name: str, why: str, tmp_path: Path):
        (tmp_path / "there.mcap").touch()
        with pytest.raises(DatasetError, match=why), Tape(tmp_path / name, small()):
            pytest.fail("it began")

    def test_a_disk_that_is_full_ends_the_flight_and_nobody_waits(self, tmp_path: Path):
        with pytest.raises(DatasetError, match="does not fit"):
            self.take(tmp_path / "flight.mcap", [reading(-k) for k in range(5000)])

    @staticmethod
    def take(path: Path, given: Iterable[Measurement | BaseException]) -> None:
        with Tape(path, small()) as tape:
            for each in given:
                if isinstance(each, BaseException):
                    raise each
                tape.add(each)


def small() -> Calibration:
    """Of images of 8 x 8 px."""
    return CALIBRATION.with_camera(0, model=replace(CALIBRATION.cameras[0].model, resolution=(8, 8)))


class TestLive:
    def test_what_a_source_brings_comes_out_and_it_is_closed(self):
        source = Scripted([reading(1), frame(2), reading(3)])
        taken = live(source)
        assert stamps(taken.measurements()) == [("ImuSample", 1), ("FrameSet", 2), ("ImuSample", 3)]
        assert source.closed.is_set()
        assert taken.figures()["readings"] == 2
        assert taken.figures()["frames"] == 1

    def test_one_that_was_never_there_is_not_waited_for(self):
        with pytest.raises(SourceError, match="no camera"):
            list(live(Scripted([SourceError("no camera found; plug one in")])).measurements())

    def test_one_that_is_lost_is_looked_for_again(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(stream, "_LOOK_EVERY_S", 0.01)
        gone = SourceError("the cable was pulled")
        taken = live(Scripted([reading(1), gone], [gone], [reading(5), gone], [reading(9)]))
        assert stamps(taken.measurements()) == [
            *(("ImuSample", 1), ("Unreadable", 1)),
            *(("ImuSample", 5), ("Unreadable", 5), ("ImuSample", 9)),
        ]
        assert taken.figures()["source_lost"] == 2

    def test_one_that_stays_away_ends_it(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(stream, "_LOOK_EVERY_S", 0.01)
        monkeypatch.setattr(stream, "_LOOKED_FOR_S", 0.1)
        gone = SourceError("the cable was pulled")
        with pytest.raises(SourceError, match="pulled"):
            list(live(Scripted([reading(1), gone], *[[gone]] * 1000)).measurements())

    def test_what_another_thread_raises_comes_out(self):
        with pytest.raises(ZeroDivisionError):
            list(live(Scripted([reading(1), ZeroDivisionError()])).measurements())

    def test_stopped_it_ends(self):
        def endless() -> Iterator[Measurement]:
            t_ns = 0
            while True:
                t_ns += 5 * MS
                time.sleep(1e-3)
                yield reading(t_ns)

        taken = live(Scripted(endless()))
        for count, _ in enumerate(taken.measurements()):
            if count == 20:
                taken.stop()
        assert 20 <= count < 200

    def test_who_is_slow_gets_all_readings_and_the_newest_frames(self):
        def quick() -> Iterator[Measurement]:
            for k in range(400):
                yield reading(k * 5 * MS)
                if k % 4 == 0:
                    yield frame(k * 5 * MS + 1)
                time.sleep(2e-4)

        taken = live(Scripted(quick()))
        got = []
        for measurement in taken.measurements():
            got.append(measurement)
            if isinstance(measurement, FrameSet):
                time.sleep(5e-3)
        frames = [m for m in got if isinstance(m, FrameSet)]
        assert sum(isinstance(m, ImuSample) for m in got) == 400
        assert taken.dropped == taken.figures()["frames_dropped"] == 100 - len(frames) > 20
        assert frames[-1].t_ns == 396 * 5 * MS + 1
        order = [m.t_ns for m in got]
        assert order == sorted(order)

    def test_the_source_hears_where_the_body_is(self):
        samples, true = TestAhead.flight()
        start, begun = true[20], Event()

        def measured() -> Iterator[Measurement]:
            for sample in samples:
                if sample.t_ns > start.t_ns and not begun.is_set():
                    begun.wait(10.0)
                yield sample

        source = Scripted(measured())
        taken = live(source)
        none = FrameTracks(start.t_ns, *(np.empty(0, np.int64),) * 2, *(np.empty((0, 2)),) * 2)
        step = Step(FrameSet(start.t_ns, (None,)), none, Estimate(Status.TRACKING, start), {})
        seeking = replace(step, estimate=Estimate(Status.INITIALISING, None))
        for measurement in taken.measurements():
            if measurement.t_ns == start.t_ns:
                assert taken.estimated(seeking) == []
                assert taken.latency_ms is None
                assert taken.estimated(step) == []
                begun.set()
        told = taken.estimated(step)
        assert len(told) == len(source.told) > 150
        assert told[0].t_ns > start.t_ns
        assert taken.latency_ms > 0.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second and a half at rest, and three and a half in flight."""
    whole = rendered_flight().measurements
    part = [m for m in whole if m.t_ns < whole[0].t_ns + 5 * NS_PER_S]
    return rendered_flight().write(tmp_path_factory.mktemp("live") / "flight.mcap", part)


SLOW = """
import time
from typing import Any
from vioframe_msckf.backend import Msckf

class SlowMsckf(Msckf):
    "Takes a while longer in flight."
    def __init__(self, *, by_s: float = 0.0):
        super().__init__()
        self.by_s = by_s
    def process(self, imu: Any, tracks: Any, still: bool) -> Any:
        time.sleep(self.by_s if tracks.t_ns > 10**10 else 0.0)  # not while it is warmed up, which begins at 0
        return super().process(imu, tracks, still)

@hookimpl
def vioframe_backends(): return {"slow_msckf": SlowMsckf}
"""


class TestConformance:
    def test_a_replay_conforms(self, recording: Path):
        check_source(Replay, str(recording), speed=5.0)
        said = CliRunner().invoke(main, ["check", "replay", "--data", str(recording)])
        assert said.exit_code == 0, said.output
        assert "keeps to all that is promised" in said.output

    def test_what_is_not_kept_is_said(self, recording: Path):
        class Deaf(Replay):
            def close(self) -> None:
                pass

        with pytest.raises(AssertionError, match=r"goes on 2 s after close"):
            check_source(Deaf, str(recording))

        class Picky(Replay):
            def tell(self, state: NavState) -> None:
                raise ValueError("no covariance")

        with pytest.raises(AssertionError, match="states without a covariance come"):
            check_source(Picky, str(recording), speed=5.0)


class TestRuns:
    """By the command line: a recording replayed at its own pace, or faster."""

    @staticmethod
    def vioframe(*arguments: object, code: int = 0) -> str:
        result = CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)
        assert result.exit_code == code, result.output
        return result.output

    @staticmethod
    def same(a: Path, b: Path) -> None:
        for name in ("trajectory.tum", "states.csv", "pose_cov.csv", "tracks.csv", "calibration.csv", "map.ply"):
            assert (a / name).read_bytes() == (b / name).read_bytes(), name

    def test_what_was_recorded_gives_the_same_bytes_again(self, recording: Path, tmp_path: Path):
        flown, again = tmp_path / "flown", tmp_path / "again"
        said = self.vioframe("run", f"replay:{recording}", "--record", tmp_path / "tape.mcap", "--out", flown)
        assert "from exposure to estimate" in said
        self.vioframe("run", tmp_path / "tape.mcap", "--out", again, "--quiet")
        self.same(flown, again)
        summary = RunFolder.open(flown).summary
        assert summary["finished"] is True
        assert summary["completion"] > 0.9
        assert summary["plugins"]["source"].startswith("vioframe")
        assert summary["live"]["readings"] == 1000
        assert summary["live"]["latency_ms"]["median"] >= 50.0  # a frame waits so long for readings
        with (flown / "imu_rate.csv").open() as file:
            rows = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
        poses = RunFolder.open(flown).trajectory()
        assert np.all(np.diff(rows[:, 0]) > 0.0)
        assert np.median(np.diff(rows[:, 0])) == 5 * MS
        # Between two frames they go from where the one was to where the other is.
        after = np.searchsorted(poses.t_ns, rows[:, 0])
        inside = np.flatnonzero((after > 0) & (after < len(poses)))
        after = after[inside]
        gap_ns = poses.t_ns[after] - poses.t_ns[after - 1]
        part = (rows[inside, 0] - poses.t_ns[after - 1]) / gap_ns
        straight = poses.p_WB[after - 1] + part[:, None] * (poses.p_WB[after] - poses.p_WB[after - 1])
        close = gap_ns <= 100 * MS
        assert close.sum() > 400
        assert np.linalg.norm(rows[inside, 1:4] - straight, axis=1)[close].max() < 0.05
        assert np.all(rows[:, 11] > 0.0)

    def test_an_estimator_that_is_too_slow_is_spared_frames_and_loses_no_reading(
        self, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ):
        """It takes twice as long as frames take to come; what it made of the rest can be had again."""
        install(tmp_path / "site", monkeypatch, distribution="slow-parts", module="slow_parts", code=SLOW)
        flown, again = tmp_path / "flown", tmp_path / "again"
        self.vioframe(
            *("run", f"replay:{recording}", "--backend", "slow_msckf", "-o", "by_s=0.2"),
            *("--record", tmp_path / "tape.mcap", "--out", flown, "--quiet"),
        )
        summary = RunFolder.open(flown).summary
        assert summary["live"]["readings"] == 1000
        assert summary["live"]["frames"] == 50
        assert 15 <= summary["incidents"]["frame_dropped"] == summary["live"]["frames_dropped"] <= 35
        assert summary["completion"] == 1.0
        assert "imu_gap" not in summary["incidents"]
        self.vioframe("run", tmp_path / "tape.mcap", "--out", again, "--quiet")
        self.same(flown, again)

    def test_of_a_part_that_is_used_the_part_is_recorded(self, recording: Path, tmp_path: Path):
        flown, again = tmp_path / "flown", tmp_path / "again"
        part = ("--start", 0.2, "--duration", 3.0)
        self.vioframe("run", f"replay:{recording}", *part, "--record", tmp_path / "tape.mcap", "--out", flown)
        self.vioframe("run", tmp_path / "tape.mcap", "--out", again, "--quiet")
        self.same(flown, again)
        assert RunFolder.open(flown).summary["frames"] <= 31

    def test_ctrl_c_ends_it_with_a_complete_folder_and_recording(self, recording: Path, tmp_path: Path):
        out, tape = tmp_path / "flown", tmp_path / "tape.mcap"
        command = [sys.executable, "-m", "vioframe", "run", f"replay:{recording}", "--out", out, "--record", tape]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ)
        timings = out / "timings.csv"
        while not (timings.is_file() and len(timings.read_text().splitlines()) > 20):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
        assert process.returncode == 0, stderr
        assert "written to" in stdout
        summary = RunFolder.open(out).summary
        assert summary["finished"] is True
        assert 20 <= summary["frames"] < 50
        assert sum(isinstance(m, FrameSet) for m in INSTALLED.open_dataset(tape).measurements()) >= summary["frames"]

    @pytest.mark.parametrize(
        ("arguments", "why"),
        [
            (["reply:flight.bag"], "no source is called 'reply' (did you mean 'replay'?)"),
            (["replay:none.bag"], "none.bag does not exist"),
            (["replay:"], "no recording named: replay:FLIGHT.bag"),
            (["{recording}", "--record", "b.mcap"], "is a recording already"),
            (["replay:{recording}", "--record", "{recording}"], "exists already"),
            (["replay:{recording}", "-o", "speed=0"], "greater than 0"),
        ],
    )
    def test_what_is_wrong_is_one_line(
        self, arguments: list[str], why: str, recording: Path, tmp_path: Path, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        said = self.vioframe("run", *(a.format(recording=recording) for a in arguments), code=2)
        assert why in said
        assert said.count("\n") == 1
        assert not Path("runs").exists()
