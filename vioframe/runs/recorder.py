"""The run folder: everything about a run, in plain files that say it all. Evaluation and reports read nothing else.

    trajectory.tum   pose of the body at every tracked frame       config.yaml      the complete configuration
    states.csv       velocity, biases, covariance diagonal         machine.json     versions, revision, cpu, threads
    pose_cov.csv     pose covariance, upper triangle               summary.json     how the run went
    tracks.csv       every feature observation                     ground_truth.tum where there is one
    timings.csv      seconds, a column a stage                     map.ply          landmarks, written at the end
    calibration.csv  what the back-end has learned of the rig, a row a camera and frame
    calibration/     as it was given, and calibration_learned/ as it was in the end, in EuRoC's format: --calibration
    imu_rate.csv     pose, velocity and pose covariance at up to 200 Hz, of a live source
    loop_corrections.csv            how loops found so far corrected the newest pose, a row where that changed
    trajectory_loop.tum, loops.csv  poses corrected by loop closure, and the loops, where a run has it

Each frame is flushed as it comes, so an interrupted run leaves what it had, with ``finished: false`` in its summary.
Nothing but the map is kept until the end, so that an hour takes hardly more memory than a minute.
All but the timings, the machine and the summary's clock-dependent figures are the same byte for byte in every run.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np

from vioframe.diagnosis import Diagnosis
from vioframe.errors import RunError
from vioframe.evaluation.landmarks import Landmarks
from vioframe.geometry import so3
from vioframe.incidents import Incidents
from vioframe.io.calibration import write_calibration
from vioframe.io.replace import remove_written
from vioframe.io.trajectories import tum_line, write_tum
from vioframe.stopwatch import working_s
from vioframe.types import (
    NS_PER_S,
    Calibration,
    CalibrationEstimate,
    Float,
    Int,
    LoopClosure,
    MapCorrection,
    NavState,
    Status,
    Step,
)

STATE_COLUMNS = (
    "t_ns",
    *(f"{name}_{axis}" for name in ("v", "bg", "ba") for axis in "xyz"),
    *(f"cov_{i}" for i in range(15)),
)
POSE_COV_COLUMNS = ("t_ns", *(f"c{i}{j}" for i in range(6) for j in range(i, 6)))
IMU_RATE_COLUMNS = ("t_ns", *"xyz", "qx", "qy", "qz", "qw", "vx", "vy", "vz", *POSE_COV_COLUMNS[1:])
CALIBRATION_COLUMNS = (
    *("t_ns", "camera", "qx", "qy", "qz", "qw", "px", "py", "pz", "time_offset_s", "readout_s"),
    *("fx", "fy", "cx", "cy", "d1", "d2", "d3", "d4"),
    *(f"sigma_{name}" for name in ("rx", "ry", "rz", "px", "py", "pz", "time_offset_s", "readout_s")),
    *(f"sigma_{name}" for name in ("fx", "fy", "cx", "cy", "d1", "d2", "d3", "d4")),
)
"""Of ``calibration.csv``: the camera by its place in the rig, its pose on the body (R_BC as a quaternion, p_BC m), time
offset and readout, intrinsics, and their standard deviations (rad, m, s, px); zero is what is not estimated."""
CORRECTION_COLUMNS = ("t_ns", "x_m", "y_m", "z_m", "yaw_rad")
LOOP_COLUMNS = ("earlier_t_ns", "later_t_ns", "x_m", "y_m", "z_m", "yaw_rad", "inliers", "accepted")
RUN_FILES = (
    *("summary.json", "config.yaml", "machine.json", "evaluation.json", "evaluation_loop.json"),
    *("trajectory.tum", "trajectory_loop.tum", "ground_truth.tum", "ground_truth_matched.tum"),
    *("states.csv", "pose_cov.csv", "imu_rate.csv", "calibration.csv", "tracks.csv", "timings.csv", "map.ply"),
    *("loops.csv", "loop_corrections.csv"),
    *("calibration/*/sensor.yaml", "calibration_learned/*/sensor.yaml"),
)
"""What a run folder holds; patterns, as are taken out where a run is replaced by another."""
_UPPER = np.triu_indices(6)
_EVENTS_KEPT_PER_KIND, _REASONS_KEPT = 20, 30
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_RECENT_LANDMARKS = 5000


def check_run_folder(path: Path, *, overwrite: bool = False, marker: str = "summary.json") -> bool:
    """Whether there is a run at ``path`` to be replaced.

    Raises :class:`RunError` where no run may be written there: only a run is ever replaced, and on request.

    ``marker`` is the file by which a folder of that kind is known.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return False
    if not overwrite:
        raise RunError(f"{path} exists already; choose another --out or pass --overwrite")
    if not (path / marker).is_file():
        raise RunError(f"{path} holds no {marker}, is not a run folder and is not overwritten; choose another --out")
    return True


def new_run_folder(
    path: Path, *, overwrite: bool = False, marker: str = "summary.json", files: Sequence[str] = RUN_FILES
) -> None:
    """Create the folder ``path``, in place of the run that is there if ``overwrite``.

    Of that run its own ``files`` go, by patterns; whatever else somebody put there stays.
    """
    check_run_folder(path, overwrite=overwrite, marker=marker)
    try:
        remove_written(path, files)
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"cannot create the run folder {path}: {error.strerror}") from error


def free_run_folder(parent: Path, name: str) -> Path:
    """``parent/name``, or with the first free number after it."""
    candidates = (parent / (name if i == 1 else f"{name}_{i}") for i in count(1))
    return next(path for path in candidates if not path.exists())


class Recorder:
    """Writes one run, step by step; a context manager that completes the folder however the run ends.

    ``about`` opens the summary, ``incidents`` close it. Time counts from ``begin_s`` of
    :func:`~vioframe.stopwatch.working_s`: kernels that had to be compiled or loaded are no part of it.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], incidents: Incidents, begin_s: float) -> None:
        self.folder = folder
        self._incidents = incidents
        self._begin_s = begin_s
        self.summary: dict[str, Any] = {**about, "finished": False}
        self._write_summary()
        self._files: dict[str, TextIO] = {}
        self._append("trajectory.tum", "# timestamp tx ty tz qx qy qz qw\n")
        self._append("states.csv", ",".join(STATE_COLUMNS) + "\n")
        self._append("pose_cov.csv", ",".join(POSE_COV_COLUMNS) + "\n")
        self._append("tracks.csv", "t_ns,id,camera,x_px,y_px\n")
        self._stages: list[str] = []
        self._map = _Map()
        self._segments: list[dict[str, int]] = []
        self._events: list[dict[str, Any]] = []
        self._event_counts: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()
        self._stage_totals: Counter[str] = Counter()
        self._frame_seconds = 0.0
        self._points = self._frames = self._tracked = self._resets = 0
        self._first_t_ns = self._last_t_ns = 0
        self._begun: tuple[int, int] | None = None
        self._tracking = False
        self._calibration: Calibration | None = None
        self._correction: MapCorrection | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in self._files.values():
            file.close()
        write_ply(self.folder / "map.ply", self._map.landmarks())
        if self._calibration is not None:
            write_calibration(self._calibration, self.folder / "calibration_learned")
        self.summary |= {
            **self._figures(),
            "events": self._events,
            "event_counts": dict(self._event_counts),
            "event_reasons": dict(self._reasons.most_common(_REASONS_KEPT)),
            "incidents": dict(sorted(self._incidents.counts.items())),
            "incident_notes": self._incidents.notes,
        }
        if error is not None:
            self.summary["stopped_by"] = " ".join(f"{type(error).__name__}: {error}".split())
        self.summary["finished"] = error is None
        self._write_summary()

    def add(self, step: Step) -> None:
        """Write one frame."""
        t_ns, tracks, estimate = step.frames.t_ns, step.tracks, step.estimate
        observations = zip(tracks.ids.tolist(), tracks.camera.tolist(), *tracks.xy.T.tolist(), strict=True)
        rows = f"{t_ns},%d,%d,%.3f,%.3f\n" * len(tracks.ids)  # all at once, a third sooner than each by itself
        self._append("tracks.csv", rows % tuple(chain.from_iterable(observations)))
        self._points += len(tracks.ids)
        self._add_timings(t_ns, step.stage_seconds)
        for event in estimate.events:
            self._add_event(t_ns, event)
        if self._frames == 0:
            self._first_t_ns = t_ns
        self._last_t_ns = t_ns
        tracking = estimate.status is Status.TRACKING and estimate.state is not None
        if self._tracking and not tracking:
            self._resets += 1
            self._map = _Map()  # a new start is a new world: old landmarks do not belong to it
        if tracking:
            assert estimate.state is not None
            if self._begun is None:
                self._begun = self._frames, t_ns
            if not self._tracking:
                self._segments.append({"first_t_ns": t_ns, "last_t_ns": t_ns, "poses": 0})
            self._tracked += 1
            self._segments[-1]["last_t_ns"] = t_ns
            self._segments[-1]["poses"] += 1
            self._add_state(t_ns, estimate.state)
            self._map.update(estimate.landmark_ids, estimate.p_WF)
            if estimate.calibration is not None:
                self._add_calibration(t_ns, estimate.calibration)
        if step.correction is not None:
            self._add_correction(t_ns, step.correction)
        self._tracking = tracking
        self._frames += 1

    def add_loop_closure(self, result: LoopClosure) -> None:
        """Write what a loop closer made of the run."""
        if result.trajectory is not None:
            write_tum(result.trajectory, self.folder / "trajectory_loop.tum")
        self._append("loops.csv", ",".join(LOOP_COLUMNS) + "\n")
        for loop in result.loops:
            pose = ",".join(f"{x:.9g}" for x in (*loop.p_L, loop.yaw))
            row = f"{loop.earlier_t_ns},{loop.later_t_ns},{pose},{loop.inliers},{int(loop.accepted)}\n"
            self._append("loops.csv", row)
        accepted = sum(loop.accepted for loop in result.loops)
        self.summary["loop_closure"] = {
            "keyframes": len(result.keyframe_t_ns),
            "loops": accepted,
            "rejected": len(result.loops) - accepted,
            "seconds_beside": dict(result.stage_seconds),
        }

    def add_between(self, states: Sequence[NavState]) -> None:
        """States that readings led to since the frame before."""
        if states and "imu_rate.csv" not in self._files:
            self._append("imu_rate.csv", ",".join(IMU_RATE_COLUMNS) + "\n")
        for state in states:
            cov = np.full((6, 6), np.nan) if state.cov is None else state.cov[:6, :6]
            values = [state.p_WB, so3.to_quat_xyzw(state.R_WB), state.v_WB, cov[_UPPER]]
            self._append("imu_rate.csv", _csv_line(state.t_ns, np.concatenate(values)))

    def add_findings(self, found: Diagnosis) -> None:
        """What was looked at in the recording, and found to be odd about it, the likeliest cause of trouble first."""
        self.summary["facts"] = found.facts
        self.summary["findings"] = [asdict(finding) for finding in found.findings]

    @property
    def initialised(self) -> bool:
        """Whether there was a pose by now."""
        return self._begun is not None

    def _add_event(self, t_ns: int, event: str) -> None:
        """Count an event by its kind, what stands before its colon; the first of a kind are kept, and its last.

        Why it came to it is counted apart, numbers left out: each of the reasons that stand behind the colon.
        """
        kind, _, reasons = event.partition(": ")
        self._event_counts[kind] += 1
        if reasons:
            self._reasons.update(_NUMBER.sub("#", reason) for reason in reasons.split("; "))
        if self._event_counts[kind] > _EVENTS_KEPT_PER_KIND:
            self._events = [e for e in self._events if e.get("last_of") != kind]
            self._events.append({"t_ns": t_ns, "event": event, "last_of": kind})
        else:
            self._events.append({"t_ns": t_ns, "event": event})

    def _add_state(self, t_ns: int, state: NavState) -> None:
        cov = np.full((15, 15), np.nan) if state.cov is None else state.cov
        values = np.concatenate([state.v_WB, state.bias_gyro_B, state.bias_accel_B])
        self._append("trajectory.tum", tum_line(t_ns, state.R_WB, state.p_WB))
        self._append("states.csv", _csv_line(t_ns, np.concatenate([values, np.diag(cov)])))
        self._append("pose_cov.csv", _csv_line(t_ns, cov[:6, :6][_UPPER]))

    def _add_calibration(self, t_ns: int, learned: CalibrationEstimate) -> None:
        if self._calibration is None:
            self._append("calibration.csv", ",".join(CALIBRATION_COLUMNS) + "\n")
        self._calibration = learned.calibration
        for place, (camera, sigma) in enumerate(zip(learned.calibration.cameras, learned.sigma, strict=True)):
            model = camera.model
            values = np.concatenate(
                [
                    so3.to_quat_xyzw(camera.R_BC),
                    camera.p_BC,
                    [camera.time_offset_ns / NS_PER_S, camera.readout_s],
                    [model.fx, model.fy, model.cx, model.cy, *model.distortion],
                    sigma.rotation,
                    sigma.position,
                    [sigma.time_offset_s, sigma.readout_s],
                    sigma.intrinsics,
                ]
            )
            self._append("calibration.csv", f"{t_ns},{place}," + _csv_values(values))

    def _add_correction(self, t_ns: int, correction: MapCorrection) -> None:
        if self._correction is None:
            self._append("loop_corrections.csv", ",".join(CORRECTION_COLUMNS) + "\n")
        elif np.array_equal(_four(correction), _four(self._correction)):
            return
        self._correction = correction
        self._append("loop_corrections.csv", _csv_line(t_ns, _four(correction)))

    def _add_timings(self, t_ns: int, stage_seconds: Mapping[str, float]) -> None:
        self._stage_totals.update(stage_seconds)
        self._frame_seconds += sum(seconds for stage, seconds in stage_seconds.items() if "." not in stage)
        new = [stage for stage in stage_seconds if stage not in self._stages]
        if new:
            self._widen_timings(new)
        row = [str(t_ns), *(f"{stage_seconds.get(stage, 0.0):.6f}" for stage in self._stages)]
        self._append("timings.csv", ",".join(row) + "\n")

    def _widen_timings(self, new: list[str]) -> None:
        """A stage seen for the first time is a new column for every row: the file starts anew."""
        self._stages += new
        rows: list[str] = []
        if file := self._files.pop("timings.csv", None):
            file.close()
            rows = (self.folder / "timings.csv").read_text(encoding="utf-8").splitlines()[1:]
        self._append("timings.csv", ",".join(["t_ns", *self._stages]) + "\n")
        self._append("timings.csv", "".join(row + ",0.000000" * len(new) + "\n" for row in rows))

    def _append(self, name: str, text: str) -> None:
        file = self._files.get(name)
        if file is None:
            file = self._files[name] = (self.folder / name).open("w", encoding="utf-8", newline="\n")
        file.write(text)
        file.flush()

    def _figures(self) -> dict[str, Any]:
        frames = self._frames
        if frames == 0:
            return {"frames": 0}
        seconds = working_s() - self._begin_s
        skipped, begun_ns = self._begun or (frames, None)
        return {
            "frames": frames,
            "first_frame_t_ns": self._first_t_ns,
            "last_frame_t_ns": self._last_t_ns,
            "initialised_t_ns": begun_ns,
            "initialised_after_s": None if begun_ns is None else (begun_ns - self._first_t_ns) / NS_PER_S,
            "completion": 0.0 if begun_ns is None else self._tracked / (frames - skipped),
            "resets": self._resets,
            "segments": self._segments,
            "tracked_points_mean": self._points / frames,
            "mean_ms": {stage: 1e3 * self._stage_totals[stage] / frames for stage in self._stages},
            "mean_frame_ms": 1e3 * self._frame_seconds / frames,
            "working_s": seconds,
            "real_time_factor": (self._last_t_ns - self._first_t_ns) / NS_PER_S / seconds,
        }

    def _write_summary(self) -> None:
        write_json(self.folder / "summary.json", self.summary)


def _four(correction: MapCorrection) -> Float:
    """(4,) its position and yaw."""
    return np.append(correction.p_MW, so3.yaw_of(correction.R_MW))


def write_json(path: Path, tree: Mapping[str, Any]) -> None:
    """Replace ``path`` as a whole."""
    write_whole(path, json.dumps(tree, indent=2, default=str) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Replace ``path`` as a whole, so that a reader never sees half of it."""
    partial = path.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


class _Map:
    """Every landmark as it was last refined. Of those of long ago nothing is kept but their numbers, 32 bytes each."""

    def __init__(self) -> None:
        self._recent: dict[int, list[float]] = {}
        self._packed: list[tuple[Int, Float]] = []

    def update(self, ids: Int, p_WF: Float) -> None:
        if len(self._recent) > _RECENT_LANDMARKS:
            self._pack()
        self._recent.update(zip(ids.tolist(), p_WF.tolist(), strict=True))

    def landmarks(self) -> Landmarks:
        self._pack()
        ids, p_WF = (np.concatenate(column) for column in zip(*self._packed, strict=True))
        # What was packed last is the newest.
        ids, last = np.unique(ids[::-1], return_index=True)
        return Landmarks(ids, p_WF[::-1][last])

    def _pack(self) -> None:
        recent = self._recent
        self._packed.append((np.array([*recent], np.int64), np.array([*recent.values()], float).reshape(-1, 3)))
        self._recent = {}


def write_ply(path: Path, landmarks: Landmarks) -> None:
    """``landmarks`` as an ASCII PLY point cloud with an ``id`` property, in order of id."""
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(landmarks)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty int id\nend_header\n"
    )
    rows = (f"{x:.6f} {y:.6f} {z:.6f} {i}\n" for i, (x, y, z) in zip(landmarks.ids, landmarks.p_WF, strict=True))
    with path.open("w", encoding="utf-8") as file:
        file.write(header)
        file.writelines(rows)


def _csv_line(t_ns: int, values: Float) -> str:
    return f"{t_ns}," + _csv_values(values)


def _csv_values(values: Float) -> str:
    return ",".join(f"{value:.9g}" for value in values.tolist()) + "\n"
