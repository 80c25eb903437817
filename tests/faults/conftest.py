"""The clean flight, made and flown once a session, and a place where it can be spoilt."""

from __future__ import annotations

from pathlib import Path

import pytest
from rendered_flight import RenderedFlight, rendered_flight

from faults.command_line import vioframe_


@pytest.fixture(scope="session")
def flight() -> RenderedFlight:
    return rendered_flight()


@pytest.fixture(scope="session")
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
