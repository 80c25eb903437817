"""A tiny recording, and parts that do with it what a test needs: for sweeps, where it matters who dies and when."""

from dataclasses import replace
from pathlib import Path
from shutil import rmtree

import pytest
from plugin_helpers import install

from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.parts import registry
from vioframe.simulation.config import SimulationConfig, complete, simulation_folder
from vioframe.simulation.record import record
from vioframe.simulation.recording import SimulatedRecording

SIDE = 8
"""How many times smaller the images are than EuRoC's."""

PARTS = '''
import os, signal
from pathlib import Path

import numpy as np
from dataclasses import replace
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.types import Estimate, NavState, Status

usual = LifeCycle.process


def from_the_first_frame(self, imu, tracks, by=None):
    # There is too little in small images to begin with, and it is no matter here.
    if not isinstance(self._backend, Counting):
        return usual(self, imu, tracks, by)
    return replace(self._backend.process(imu, tracks, False), calibration=self._known)


LifeCycle.process = from_the_first_frame


class Counting:
    """Says it is where the number of its tracks puts it; may fail or die at its third frame, the first times."""

    def __init__(self, *, fail: int = 0, die: int = 0, flag: str = "", step_m: float = 0.01):
        self._left, self._flag, self._step_m, self._frames = max(fail, die), Path(flag), step_m, 0
        self._dies = die > 0

    def begin(self, start):
        self._left = 0  # this is no flight, but the warming up before

    def process(self, imu, tracks, still):
        self._frames += 1
        if self._frames == 3 and self._left:
            before = len(list(self._flag.glob("*")))
            if before < self._left:
                (self._flag / str(before)).touch()
                if self._dies:
                    os.kill(os.getpid(), signal.SIGKILL)
                raise ValueError("it fails as it was told to")
        p_WB = self._step_m * np.array([self._frames, len(tracks.ids) % 7, self._frames**0.5])
        zero = np.zeros(3)
        return Estimate(Status.TRACKING, NavState(tracks.t_ns, np.eye(3), p_WB, zero, zero, zero))


@hookimpl
def vioframe_backends():
    return {"counting": Counting}
'''


def record_toy(folder: Path, name: str = "TOY", **settings: object) -> Path:
    """An ASL folder of 3 s at 10 Hz with small images and truth, which says nothing of having been simulated."""
    calibration = packaged_calibration("euroc", cameras=["cam0"])
    (camera,) = calibration.cameras
    small = replace(
        camera.model,
        resolution=(camera.model.resolution[0] // SIDE, camera.model.resolution[1] // SIDE),
        **{key: getattr(camera.model, key) / SIDE for key in ("fx", "fy", "cx", "cy")},
    )
    files = folder / "calibration"
    write_calibration(replace(calibration, cameras=(replace(camera, model=small),)), files)
    config = SimulationConfig(duration_s=3.0, frame_rate_hz=10.0, rig=(str(files),), **settings)
    installed = registry.load()
    path = folder / name
    record(SimulatedRecording(complete(config, installed), installed), [path])
    rmtree(simulation_folder(path))
    return path


def install_parts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the back-end ``counting`` known, to processes begun from here as well."""
    install(folder, monkeypatch, distribution="toy-parts", module="toy_parts", code=PARTS)
    monkeypatch.setenv("PYTHONPATH", str(folder))
