"""Reads the folder that a run leaves behind, also where the run was interrupted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from vioframe.errors import ConfigError, RunError
from vioframe.evaluation.landmarks import Landmarks, read_landmarks
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory
from vioframe.parts.config import DatasetConfig, read_tree
from vioframe.types import Calibration, Float, Int

_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class Timings:
    """Seconds a frame by stage, (N,) each. ``a.b`` is a part of ``a``; a stage that did not take place took 0."""

    t_ns: Int
    seconds: Mapping[str, Float]

    def exclusive(self) -> dict[str, Float]:
        """Seconds by stage such that they add up to the whole: ``a.other`` is what the parts of ``a`` leave of it."""
        out = {}
        for stage, spent in self.seconds.items():
            parts = [other for name, other in self.seconds.items() if name.rpartition(".")[0] == stage]
            if parts:
                out[f"{stage}.other"] = np.maximum(spent - np.sum(parts, axis=0), 0.0)
            else:
                out[stage] = spent
        return out

    def mean_ms(self) -> dict[str, float]:
        """Mean milliseconds a frame by stage, adding up to the whole."""
        return {stage: 1e3 * float(spent.mean()) for stage, spent in self.exclusive().items()}


@dataclass(frozen=True)
class States:
    """What belongs to the N tracked poses: velocity m/s and biases (N, 3), rad/s and m/s^2.

    ``sigma`` (N, 15) are the standard deviations of the error state [dtheta dp dv dbg dba], NaN where not known.
    """

    t_ns: Int
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float
    sigma: Float


@dataclass(frozen=True)
class Tracks:
    """Every feature observation of the frames ``frames_ns`` (N,), each in order of time.

    ``ids`` (M,) and ``xy`` (M, 2) px at ``t_ns`` (M,), seen by the camera (M,) of that place in the rig.
    """

    frames_ns: Int
    t_ns: Int
    ids: Int
    camera: Int
    xy: Float

    @property
    def tracked(self) -> Int:
        """(N,) how many observations each frame holds; a frame without any has no row, but it has its timings."""
        return _count(self.t_ns, self.frames_ns)

    def seen_by(self, camera: int) -> Tracks:
        """Those of one camera."""
        own = self.camera == camera
        return Tracks(self.frames_ns, self.t_ns[own], self.ids[own], self.camera[own], self.xy[own])

    @property
    def is_new(self) -> NDArray[np.bool_]:
        """(M,) whether it is the first observation of its feature."""
        out = np.zeros(len(self.ids), dtype=bool)
        out[np.unique(self.ids, return_index=True)[1]] = True
        return out

    @property
    def new(self) -> Int:
        """(N,) how many features were seen for the first time in each frame."""
        return _count(self.t_ns[self.is_new], self.frames_ns)


@dataclass(frozen=True)
class RunFolder:
    """A run on disk. ``summary`` is empty, or lacks its figures, where the run was cut short."""

    path: Path
    summary: Mapping[str, Any]

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether ``path`` holds a run."""
        return (path / "trajectory.tum").is_file()

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Raises :class:`RunError` where ``path`` holds no run."""
        path = Path(path)
        if not cls.is_at(path):
            raise RunError(f"{path} is not a run folder: it holds no trajectory.tum; give what `vioframe run` wrote")
        try:
            summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError):
            summary = {}
        return cls(path, summary if isinstance(summary, dict) else {})

    @property
    def name(self) -> str:
        """The folder's own name, which tells runs of one flight apart."""
        return self.path.resolve().name

    def trajectory(self) -> Trajectory | None:
        """The estimate, with its covariance where it was recorded; None where the run never got as far as a pose."""
        path = self.path / "trajectory.tum"
        if not any(line[:1] not in ("#", "\n") for line in _complete_lines(path)):
            return None
        estimate = load_trajectory(path, complete_lines_only=True)
        cov = self._pose_covariance(estimate.t_ns)
        return estimate if cov is None else Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, cov)

    def loop_closed(self) -> Trajectory | None:
        """The estimate as loop closure corrected it; None where the run had none, or did not get to its end."""
        path = self.path / "trajectory_loop.tum"
        return load_trajectory(path) if path.is_file() else None

    def segment_starts_ns(self) -> tuple[int, ...]:
        """Stamps at which tracking began again after a reset."""
        return tuple(int(segment["first_t_ns"]) for segment in self.summary.get("segments", [])[1:])

    def ground_truth(self) -> Trajectory | None:
        """The ground truth that the run was given, if any."""
        path = self.path / "ground_truth.tum"
        return load_trajectory(path) if path.is_file() else None

    def dataset_config(self) -> DatasetConfig:
        """What the run was made on; its path is None where the run's configuration does not say, and may be gone."""
        try:
            return DatasetConfig.model_validate(read_tree(self.path / "config.yaml").get("dataset", {}))
        except (ConfigError, ValidationError):
            return DatasetConfig()

    def calibration(self) -> Calibration | None:
        """The calibration that the run was given; None in run folders that were written without it."""
        return self._calibration_in("calibration")

    def learned_calibration(self) -> Calibration | None:
        """What the back-end believed of the rig in the end; None where it learns nothing of it."""
        return self._calibration_in("calibration_learned")

    def _calibration_in(self, name: str) -> Calibration | None:
        from vioframe.io.calibration import load_calibration

        path = self.path / name
        return load_calibration(path) if path.is_dir() else None

    def landmarks(self) -> Landmarks | None:
        """The landmarks in the world of the estimate, all of them; None where the run was cut off before its end."""
        path = self.path / "map.ply"
        return read_landmarks(path) if path.is_file() else None

    def timings(self) -> Timings | None:
        """None where there are none."""
        table = self._table("timings.csv")
        if table is None:
            return None
        return Timings(table["t_ns"], {stage: table[stage] for stage in table.dtype.names or () if stage != "t_ns"})

    def tracks(self) -> Tracks | None:
        """None where no frame was recorded."""
        table, timings = self._table("tracks.csv"), self.timings()
        if table is None or timings is None:
            return None
        table = table[np.isin(table["t_ns"], timings.t_ns)]  # the last frame of an interrupted run may lack its times
        xy = np.column_stack([table["x_px"], table["y_px"]])
        return Tracks(timings.t_ns, table["t_ns"], table["id"], table["camera"], xy)

    def states(self) -> States | None:
        """None where no pose was recorded."""
        table = self._table("states.csv")
        if table is None:
            return None
        v_WB, gyro, accel = (np.column_stack([table[f"{n}_{a}"] for a in "xyz"]) for n in ("v", "bg", "ba"))
        sigma = np.sqrt(np.column_stack([table[f"cov_{i}"] for i in range(15)]))
        return States(table["t_ns"], v_WB, gyro, accel, sigma)

    def _pose_covariance(self, t_ns: Int) -> Float | None:
        """(N, 6, 6), NaN where a pose has none; None where no pose has one."""
        table = self._table("pose_cov.csv")
        if table is None:
            return None
        cov = np.full((len(t_ns), 6, 6), np.nan)
        _, row, source = np.intersect1d(t_ns, table["t_ns"], return_indices=True)
        upper = np.column_stack([table[f"c{i}{j}"] for i, j in zip(*_UPPER, strict=True)])[source]
        cov[row[:, None], _UPPER[0], _UPPER[1]] = upper
        cov[row[:, None], _UPPER[1], _UPPER[0]] = upper
        return cov if np.isfinite(cov).all(axis=(1, 2)).any() else None

    def _table(self, name: str) -> NDArray[np.void] | None:
        """The rows of a csv file by column name, stamps and ids as integers; None where the file has no row."""
        path = self.path / name
        lines = _complete_lines(path)
        if len(lines) < 2:
            return None
        columns = lines[0].strip().split(",")
        dtype = np.dtype(
            [(column, np.int64 if column in ("t_ns", "id", "camera") else np.float64) for column in columns]
        )
        try:
            return np.loadtxt(StringIO("".join(lines[1:])), dtype=dtype, delimiter=",", ndmin=1)
        except ValueError as error:
            reason = " ".join(str(error).split())
            raise RunError(f"{path} is damaged ({reason}); delete it to go on without it") from None


def _complete_lines(path: Path) -> list[str]:
    """The lines up to the last line end: an interrupted run may leave half a line; none where the file is missing."""
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    return text[: text.rfind("\n") + 1].splitlines(keepends=True)


def _count(stamps: Int, t_ns: Int) -> Int:
    """(N,) how often each of ``t_ns`` occurs in ``stamps``, which ascend."""
    return np.searchsorted(stamps, t_ns, "right") - np.searchsorted(stamps, t_ns, "left")
