"""Results folders of made-up suites, in the format of ``vioframe bench``, without running an estimator."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from ruamel.yaml import YAML
from trajectory_helpers import disturbed, flight, write_run

from vioframe.bench.suites.tasks import of_errors
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.parts.config import read_tree
from vioframe.report.suite.statistics import Study
from vioframe.runs.evaluated import write_matched_truth
from vioframe.runs.folder import RunFolder
from vioframe.runs.results import Data, Results, load_results, read_rows, write_rows

MACHINE = {"vioframe": "0.1.0", "commit": "abc", "cpu": "a processor", "cpu_count": 2, "versions": {"numpy": "2.0"}}
POSES = 160


THESIS = Path(__file__).parents[1] / "benchmarks" / "thesis" / "thesis.yaml"
"""A reference that the shipped suites name."""


def labels(
    sequence: str = "MH_05_difficult",
    condition: str = "clear",
    level: float = 0.0,
    detector: str = "shi_tomasi",
    backend: str = "msckf",
    seed: int = 0,
) -> dict[str, Any]:
    """The columns of a row that say where in the suite's grid it stands."""
    where = {"sequence": sequence, "condition": condition, "level": level}
    return {**where, "detector": detector, "backend": backend, "seed": seed}


class MadeUp:
    """A results folder that grows task by task; :meth:`load` reads it back."""

    def __init__(self, path: Path, *, reference: bool = False, **suite: Any) -> None:
        self.path = path
        tree = {"name": "made_up", "title": "A made-up suite", "description": "For tests.", "kind": "flights", **suite}
        if reference:
            tree["reference"] = read_tree(THESIS)
        path.mkdir(parents=True)
        with (path / "suite.yaml").open("w", encoding="utf-8") as file:
            YAML().dump(tree, file)

    def load(self) -> Results:
        return load_results(self.path)

    def study(self) -> Study:
        return Study(self.load())

    def change(self, task: str, **columns: Any) -> None:
        """Other values in the row of a task."""
        rows = read_rows(self.path)
        write_rows(self.path, {**rows, task: [{**row, **columns} for row in rows[task]]})

    def flight(
        self,
        of: Mapping[str, Any],
        *,
        data: Data = Data.RENDERED,
        sigma_m: float = 0.05,
        bias_m: tuple[float, float, float] | None = None,
        completion: float = 1.0,
        estimate: Trajectory | None = None,
        **more: Any,
    ) -> Path:
        """A flight whose estimate is the truth with noise of ``sigma_m``, or ``estimate``; returns its run folder.

        ``bias_m`` is added to the second half of the path, where alignment cannot undo it. ``more`` are other columns.
        """
        run = self.path / "runs" / key(of)
        truth = flight(POSES, seed=3)
        if estimate is None:
            estimate = disturbed(truth, sigma_m, 0.01, seed=of["seed"] + 17)
            if bias_m is not None:
                late = (np.arange(POSES) >= POSES // 2)[:, None]
                estimate = Trajectory(truth.t_ns, estimate.R_WB, estimate.p_WB + late * np.array(bias_m))
        honest = np.broadcast_to(np.diag([1e-4] * 3 + [2.0 * sigma_m**2] * 3), (len(estimate), 6, 6))
        write_run(run, Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, honest), truth, waiting=5)
        write_matched_truth(run)
        folder = RunFolder.open(run)
        written, timings = folder.trajectory(), folder.timings()
        assert written is not None
        assert timings is not None
        figures = {
            "completion": completion,
            "resets": 0,
            "frames": POSES,
            "finished": True,
            "loop_closed": False,
            "initialised_after_s": 0.25,
            "start_s": 5.0 + 0.5 * of["seed"],
            "real_time_factor": 2.5,
            "frame_ms": folder.summary["mean_frame_ms"],
            **{f"stage_ms.{stage}": ms for stage, ms in timings.mean_ms().items()},
            **of_errors(evaluate(written, truth)),
        }
        self._add("flight", of, data, {**figures, **more, "folder": f"runs/{key(of)}"})
        return run

    def failed(
        self, of: Mapping[str, Any], error: str = "PluginError: it broke", data: Data | None = Data.RENDERED
    ) -> None:
        self._add("flight", of, data, {"status": "failed", "error": error, "attempts": 2})

    def never_initialised(self, of: Mapping[str, Any], data: Data = Data.RENDERED) -> None:
        folder = self.path / "runs" / key(of)
        folder.mkdir(parents=True)
        figures = {"completion": 0.0, "frames": POSES, "finished": True, "stage_ms.klt": 3.0, "frame_ms": 3.0}
        event = "initialisation refused: not at rest"
        self._add("flight", of, data, {**figures, "last_event": event, "folder": f"runs/{key(of)}"})

    def trial(self, backend: str, seed: int, scale: float, failure: str | None = None) -> None:
        """A trial whose NEES is ``scale`` times that of an honest filter, or one that is nothing but a ``failure``."""
        of = labels("figure_eight", detector="simulated tracks", backend=backend, seed=seed)
        folder = self.path / "runs" / key(of)
        folder.mkdir(parents=True)
        figures: dict[str, Any] = {}
        if not failure:
            rng = np.random.default_rng(seed)
            parts = {"orientation": 3, "position": 3, "pose": 6}
            nees = pd.DataFrame({part: scale * rng.chisquare(dof, 200) for part, dof in parts.items()})
            nees.insert(0, "t_ns", 50_000_000 * np.arange(200))
            nees.to_csv(folder / "nees.csv", index=False)
            figures = {"ate_m": 0.1, "percent": 0.2, "orientation_deg": 0.5, "completion": 1.0, "resets": 0}
        self._add("trial", of, Data.SIMULATED, {**figures, "failure": failure, "folder": f"runs/{key(of)}"})

    def detector_speed(self) -> None:
        settings = {
            "images": "drawn surfaces",
            "image_count": 8,
            "rounds": 10,
            "width": 640,
            "height": 480,
            "max_points": 300,
            "devices": ["a processor, 2 cores"],
        }
        for name, fps in (("shi_tomasi", 250.0), ("orb", 80.0), ("fast", 700.0)):
            quartiles = {"fps": fps, "fps_low": 0.9 * fps, "fps_high": 1.1 * fps, "ms": 1e3 / fps}
            row = {"detector": name, **quartiles, "keypoints": 300.0, "calls": 80, "on": "cpu", **settings}
            self._add("speed", row, None, row)
        absent = {"detector": "superpoint", "status": "absent", "error": "needs the option 'weights'"}
        self._add("speed", absent, None, absent)

    def _add(self, kind: str, of: Mapping[str, Any], data: Data | None, figures: Mapping[str, Any]) -> None:
        task = "detector_speed" if kind == "speed" else key(of)
        about = "" if kind == "speed" else f"{of['sequence']}: made up for a test"
        row = {
            "task": task,
            "kind": kind,
            **of,
            "data": None if data is None else data.value,
            "data_note": about,
            "code": "1",
            "config": "2",
            "inputs": "3",
            "status": "ok",
            "error": "",
            "attempts": 1,
            "seconds": 1.0,
            "machine": MACHINE,
            "folder": None,
            **figures,
        }
        rows = read_rows(self.path)
        write_rows(self.path, {**rows, task: [*(rows.get(task, ()) if kind == "speed" else ()), row]})


def key(of: Mapping[str, Any]) -> str:
    where = f"{of['sequence']}.{of['condition']}_{of['level']:g}"
    return f"{where}.{of['detector']}.{of['backend']}.seed{of['seed']}".replace(" ", "_")


def comparison(path: Path, *, reference: bool = True) -> MadeUp:
    """Two detectors with two back-ends on MH_05_difficult, two seeds; one flight failed, one never initialised."""
    made = MadeUp(
        path,
        detectors=["shi_tomasi", {"name": "keypointnet", "options": {"threads": 1}}],
        backends=["sliding_window", "msckf"],
        sequences=[{"name": "MH_05_difficult", "start_s": 5.0}],
        seeds=2,
        reference=reference,
    )
    for d, detector in enumerate(("shi_tomasi", "keypointnet")):
        for b, backend in enumerate(("msckf", "sliding_window")):
            for seed in range(2):
                of = labels(detector=detector, backend=backend, seed=seed)
                if (d, b, seed) == (0, 0, 1):
                    made.failed(of)
                elif (d, b, seed) == (1, 0, 1):
                    made.never_initialised(of)
                else:
                    made.flight(of, sigma_m=0.04 + 0.03 * d + 0.01 * b + 0.005 * seed)
    return made


def stress(path: Path) -> MadeUp:
    """Two detectors with one back-end, clear and under fog and blur at two levels, two seeds; keypointnet is better."""
    made = MadeUp(
        path,
        detectors=["shi_tomasi", "keypointnet"],
        backends=["msckf"],
        sequences=["figure_eight"],
        conditions={"motion_blur": [0.5, 1.0], "fog": [0.5, 1.0]},
        seeds=2,
    )
    grid = [("clear", 0.0), *((name, level) for name in ("motion_blur", "fog") for level in (0.5, 1.0))]
    for condition, level in grid:
        for detector, factor in (("shi_tomasi", 2.0), ("keypointnet", 1.0)):
            for seed in range(2):
                of = labels("figure_eight", condition, level, detector, seed=seed)
                if (condition, level, detector, seed) == ("fog", 1.0, "shi_tomasi", 1):
                    made.failed(of, data=Data.SIMULATED)
                else:
                    sigma_m = 0.02 * factor * (1.0 + 3.0 * level) * (1.0 + 0.2 * seed)
                    made.flight(of, data=Data.SIMULATED, sigma_m=sigma_m)
    return made
