"""Results folders of made-up suites, in the format of ``vioframe bench``, without running an estimator."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from trajectory_helpers import disturbed, flight, write_run

from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.report.suite.results import Data, Kind, Labels, SuiteResults, load_results
from vioframe.runs.evaluated import write_matched_truth
from vioframe.runs.folder import RunFolder

MACHINE = {"vioframe": "0.1.0", "commit": "abc", "cpu": "a processor", "cpu_count": 2, "versions": {"numpy": "2.0"}}
POSES = 160


def labels(
    sequence: str = "MH_05_difficult",
    condition: str = "clear",
    level: float = 0.0,
    detector: str = "shi_tomasi",
    backend: str = "msckf",
    seed: int = 0,
) -> Labels:
    return Labels(sequence, condition, level, detector, backend, seed)


class MadeUp:
    """A results folder that grows task by task; :meth:`load` reads it back."""

    def __init__(self, path: Path, **suite: Any) -> None:
        self.path = path
        tree = {"name": "made_up", "title": "A made-up suite", "description": "For tests.", "kind": "flights", **suite}
        path.mkdir(parents=True)
        with (path / "suite.yaml").open("w", encoding="utf-8") as file:
            YAML().dump(tree, file)

    def load(self) -> SuiteResults:
        return load_results(self.path)

    def flight(
        self,
        of: Labels,
        *,
        data: Data = Data.RENDERED,
        sigma_m: float = 0.05,
        bias_m: tuple[float, float, float] | None = None,
        completion: float = 1.0,
        metrics: Mapping[str, Any] | None = None,
        estimate: Trajectory | None = None,
    ) -> Path:
        """A flight whose estimate is the truth with noise of ``sigma_m``, or ``estimate``; returns its run folder.

        ``bias_m`` is added to the second half of the path, where alignment cannot undo it.
        """
        run = self.path / "tasks" / key(of) / "run"
        truth = flight(POSES, seed=3)
        if estimate is None:
            estimate = disturbed(truth, sigma_m, 0.01, seed=of.seed + 17)
            if bias_m is not None:
                late = (np.arange(POSES) >= POSES // 2)[:, None]
                estimate = Trajectory(truth.t_ns, estimate.R_WB, estimate.p_WB + late * np.array(bias_m))
        honest = np.broadcast_to(np.diag([1e-4] * 3 + [2.0 * sigma_m**2] * 3), (len(estimate), 6, 6))
        write_run(run, Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, honest), truth, waiting=5)
        write_matched_truth(run)
        folder = RunFolder.open(run)
        summary = {
            **folder.summary,
            "completion": completion,
            "initialised_after_s": 0.25,
            "start_s": 5.0 + 0.5 * of.seed,
        }
        written, timings = folder.trajectory(), folder.timings()
        assert written is not None
        assert timings is not None
        result = {
            "summary": summary,
            "evaluation": evaluate(written, truth).to_dict(),
            "evaluation_loop": None,
            "metrics": metrics or {},
            "stage_ms": timings.mean_ms(),
            "real_time_factor": 2.5,
        }
        self._write(Kind.FLIGHT, of, data, result)
        return run

    def failed(self, of: Labels, error: str = "PluginError: it broke", data: Data | None = Data.RENDERED) -> None:
        self._write(Kind.FLIGHT, of, data, {}, error)

    def never_initialised(self, of: Labels, data: Data = Data.RENDERED) -> None:
        event = {"t_ns": 1, "event": "initialisation refused: not at rest"}
        summary = {"initialised_after_s": None, "completion": 0.0, "frames": POSES, "finished": True, "events": [event]}
        result = {
            "summary": summary,
            "evaluation": None,
            "evaluation_loop": None,
            "metrics": {},
            "stage_ms": {"klt": 3.0},
        }
        self._write(Kind.FLIGHT, of, data, result)

    def trial(self, backend: str, seed: int, scale: float, failure: str | None = None) -> None:
        """A trial whose NEES is ``scale`` times that of an honest filter, or one that is nothing but a ``failure``."""
        rng = np.random.default_rng(seed)
        parts = {"orientation": 3, "position": 3, "pose": 6}
        nees = {} if failure else {part: (scale * rng.chisquare(dof, 200)).tolist() for part, dof in parts.items()}
        figures = (
            {} if failure else {"ate_m": 0.1, "percent": 0.2, "orientation_deg": 0.5, "completion": 1.0, "resets": 0}
        )
        trial = {"seed": seed, "failure": failure, "detail": "", **figures, "nees": {}}
        t_s = [] if failure else (0.05 * np.arange(200)).tolist()
        of = labels("figure_eight", detector="simulated tracks", backend=backend, seed=seed)
        self._write(Kind.TRIAL, of, Data.SIMULATED, {"trial": trial, "nees": nees, "t_s": t_s})

    def detector_speed(self) -> None:
        rows = [_speed("shi_tomasi", 250.0, 160.0), _speed("orb", 80.0, 33.0), _speed("fast", 700.0, None)]
        settings = {
            "images": "drawn surfaces",
            "image_count": 8,
            "rounds": 10,
            "resolution": [640, 480],
            "max_points": 300,
            "devices": ["a processor, 2 cores"],
        }
        result = {"rows": rows, "absent": {"superpoint": "needs the option 'weights'"}, "settings": settings}
        self._write(Kind.DETECTOR_SPEED, None, None, result)

    def _write(self, kind: Kind, of: Labels | None, data: Data | None, result: Any, error: str = "") -> None:
        name = "detector_speed" if of is None else key(of)
        folder = self.path / "tasks" / name
        folder.mkdir(parents=True, exist_ok=True)
        about = "" if of is None else f"{of.sequence}: made up for a test"
        tree = {
            "key": name,
            "kind": kind.value,
            "labels": None if of is None else asdict(of),
            "data": None if data is None else data.value,
            "data_note": about,
            "fingerprint": {"code": "1", "config": "2", "data": "3"},
            "status": "failed" if error else "ok",
            "error": error,
            "attempts": 2 if error else 1,
            "seconds": 1.0,
            "machine": MACHINE,
            "result": result,
        }
        (folder / "task.json").write_text(json.dumps(tree), encoding="utf-8")


def key(of: Labels) -> str:
    return f"{of.sequence}.{of.condition}_{of.level:g}.{of.detector}.{of.backend}.seed{of.seed}".replace(" ", "_")


def comparison(path: Path) -> MadeUp:
    """Two detectors with two back-ends on MH_05_difficult, two seeds; one flight failed, one never initialised."""
    made = MadeUp(
        path,
        detectors=["shi_tomasi", {"name": "keypointnet", "options": {"threads": 1}}],
        backends=["sliding_window", "msckf"],
        sequences=[{"name": "MH_05_difficult", "start_s": 5.0}],
        seeds=2,
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


def _speed(name: str, fps: float, quoted: float | None) -> dict[str, Any]:
    return {
        "detector": name,
        "calls": 80,
        "measured": {
            "fps": fps,
            "fps_quartiles": [0.9 * fps, 1.1 * fps],
            "ms": 1e3 / fps,
            "ms_quartiles": [0.9e3 / fps, 1.1e3 / fps],
            "points": 300.0,
            "on": "cpu",
        },
        "quoted": None if quoted is None else {"fps": quoted, "source": "thesis"},
    }
