"""Reading a recording, and decoding its images, in a thread of its own."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from vioframe.errors import DatasetError
from vioframe.io import ahead
from vioframe.io.ahead import decoded_ahead, read_ahead
from vioframe.types import FrameSet, ImuSample, Measurement


class Source:
    """``frames`` frames with three readings before each and one behind the last; notes what is asked of it."""

    def __init__(self, frames: int, fails_at: int | None = None) -> None:
        self.given = 0
        self.threads: set[str] = set()
        self.closed_by: str | None = None
        self._frames, self._fails_at = frames, fails_at

    def __iter__(self) -> Iterator[Measurement]:
        try:
            for t_ns in range(4 * self._frames + 1):
                if t_ns == self._fails_at:
                    raise DatasetError("cut off")
                self.threads.add(threading.current_thread().name)
                self.given += 1
                yield FrameSet(t_ns, ()) if t_ns % 4 == 3 else ImuSample(t_ns, np.zeros(3), np.zeros(3))
        finally:
            self.closed_by = threading.current_thread().name


@pytest.mark.parametrize("frames", [0, 1, 20])
def test_all_comes_in_its_order(frames: int):
    source = Source(frames)
    assert [m.t_ns for m in read_ahead(source)] == list(range(4 * frames + 1))
    assert len(source.threads) == 1
    assert threading.current_thread().name not in source.threads


def test_only_a_few_frames_are_ahead():
    source = Source(20)
    for count, _ in enumerate(read_ahead(source), start=1):
        assert source.given <= count + 4 * 6
    assert source.given == count


@pytest.mark.parametrize("at", [0, 3, 42])
def test_what_was_read_before_an_error_comes_first(at: int):
    came: list[int] = []
    with pytest.raises(DatasetError, match="cut off"):
        came.extend(m.t_ns for m in read_ahead(Source(20, fails_at=at)))
    assert came == list(range(at))


def test_left_early_the_source_is_closed_by_who_opened_it():
    source = Source(20)
    ahead = read_ahead(source)
    for _ in range(5):
        next(ahead)
    ahead.close()
    assert source.given < 4 * 7
    assert {source.closed_by} == source.threads
    assert not any(thread.name.startswith("reader") for thread in threading.enumerate())


def test_an_interpreter_ends_quietly_with_one_that_is_not_through():
    code = (
        "from functools import partial\n"
        "from vioframe.io.ahead import decoded_ahead, read_ahead\n"
        "from vioframe.types import FrameSet\n"
        "left = read_ahead(decoded_ahead(partial(FrameSet, t_ns, ()) for t_ns in range(100)))\n"
        "print(next(left).t_ns)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert (done.stdout, done.stderr) == ("0\n", "")


class Undecoded:
    """``frames`` frames that are still to be made, with three readings before each; notes what is asked of it."""

    def __init__(self, frames: int, damaged: int | None = None, cut_off: int | None = None) -> None:
        self.made: list[int] = []
        self.threads: set[str] = set()
        self._frames, self._damaged, self._cut_off = frames, damaged, cut_off

    def __iter__(self) -> Iterator[Measurement | Callable[[], Measurement]]:
        for t_ns in range(4 * self._frames):
            if t_ns == self._cut_off:
                raise DatasetError("cut off")
            yield (lambda t_ns=t_ns: self._make(t_ns)) if t_ns % 4 == 3 else ImuSample(t_ns, np.zeros(3), np.zeros(3))

    def _make(self, t_ns: int) -> Measurement:
        self.threads.add(threading.current_thread().name)
        if t_ns == self._damaged:
            raise DatasetError("damaged")
        self.made.append(t_ns)
        return FrameSet(t_ns, ())


@pytest.fixture(params=[1, 2], ids=["one-core", "two-cores"])
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(ahead, "usable_cores", lambda: request.param)
    return int(request.param)


@pytest.mark.parametrize("frames", [0, 1, 20])
def test_decoded_all_comes_in_its_order(cores: int, frames: int):
    source = Undecoded(frames)
    came = list(decoded_ahead(source))
    assert [m.t_ns for m in came] == list(range(4 * frames))
    assert all(isinstance(m, FrameSet) == (m.t_ns % 4 == 3) for m in came)
    by_others = source.threads - {threading.current_thread().name}
    assert len(by_others) == (1 if cores > 1 and frames else 0)


def test_only_a_few_images_are_decoded_ahead(cores: int):
    source = Undecoded(20)
    for count, _ in enumerate(decoded_ahead(source), start=1):
        assert len(source.made) <= count // 4 + (5 if cores > 1 else 0)


def test_what_needs_no_decoding_is_passed_on_at_once(cores: int):
    source = Source(20)
    for count, _ in enumerate(decoded_ahead(source), start=1):
        assert source.given == count


def test_what_cannot_be_decoded_or_read_fails_in_its_turn(cores: int):
    for at, source in ((39, Undecoded(20, damaged=39)), (42, Undecoded(20, cut_off=42))):
        came: list[int] = []
        with pytest.raises(DatasetError, match=r"damaged|cut off"):
            came.extend(m.t_ns for m in decoded_ahead(source))
        assert came == list(range(at))


def test_left_early_no_more_is_decoded(cores: int):
    source = Undecoded(20)
    decoded = decoded_ahead(source)
    for _ in range(5):
        next(decoded)
    decoded.close()
    assert len(source.made) <= 7
    assert not any(thread.name.startswith("decoder") for thread in threading.enumerate())
