"""Starting anywhere, with a calibration that does not fit: every half second of five recordings, and each fault.

    python benchmarks/starts.py [--record] [--every 0.5] [--workers 2]

Real tracks of MH_01_easy_15s and of an AprilGrid, and landmarks seen along three simulated flights in worlds of their
own: no limit was chosen by looking at these. Started within 2.5 s of sufficient motion (5 s with a wrong rotation) in
95 % of them; no bad start: scale off by more than 5 % two seconds later (from the time of sufficient motion, where it
began at rest), or a reset within ten.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from april_board import april_sequence
from common import benchmark, present, tracked
from threadpoolctl import threadpool_limits

from vioframe.bench import Row
from vioframe.bench.processes import installed, map_in_processes
from vioframe.errors import TrajectoryError
from vioframe.evaluation import evaluate
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.odometry import Odometry
from vioframe.parts import config as configuration
from vioframe.parts.config import Config, PartConfig
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.types import Calibration, FrameTracks, NavState, Status

FLIGHTS = {"walk": 20.0, "hover": 20.0, "inspection": 20.0}
"""Simulated ones, and how long each is flown, s."""
_FIRST_WORLD = 40  # limits were chosen in those below
FAULTS = (
    *("none", "offset +30 ms", "offset -30 ms", "offset +100 ms", "offset -100 ms"),
    *("rotation 10 deg", "rotation 90 deg", "focal +10 %", "focal -10 %"),
)
_AXIS = np.array([0.6, 0.64, 0.48])
_LOOKED_AT_S, _RESET_S, _SCALE_S = 8.0, 10.0, 2.0
# Motion is sufficient once a body has, within 1.5 s, gone so far, changed its velocity and turned by so much (rms).
_WITHIN_S, _GONE_M, _CHANGED_M_S, _TURNED_RAD = 1.5, 0.1, 0.08, np.deg2rad(1.0)
COLUMNS = {
    "recording": "",
    "fault": "",
    "starts": "d",
    "in_time_percent": ".1f",
    "after_s": ".2f",
    "slowest_s": ".2f",
    "bad": "d",
    "scale_percent": ".2f",
    "resets": "d",
}


@dataclass(frozen=True)
class Starts:
    """Attempts on ``sequence`` from each of ``begin_s`` on, with the calibration that ``fault`` makes."""

    name: str
    sequence: TrackSequence
    begin_s: tuple[float, ...]
    fault: str
    config: Config


@benchmark
@click.option("--every", "every_s", default=0.5, show_default=True, help="Seconds from one start to the next.")
@click.option("--workers", default=2, show_default=True, help="Processes.")
@click.option("--only", multiple=True, metavar="NAME", help="Recordings.  [default: all]")
def main(
    data: Path,
    backend: str,
    assignments: tuple[str, ...],
    keep: bool,
    every_s: float,
    workers: int,
    only: tuple[str, ...],
) -> None:
    """Starts anywhere, with right and wrong calibrations."""
    config = configuration.override(Config(backend=PartConfig(name=backend)), installed(), assignments)

    def rows() -> Iterator[Row]:
        for name, sequence in sequences(data):
            if only and name not in only:
                continue
            t_ns = sequence.ground_truth.t_ns
            last_s = (t_ns[-1] - t_ns[0]) * 1e-9 - 4.0
            begin_s = tuple(np.arange(0.0, last_s, every_s).tolist())
            jobs = [Starts(name, sequence, begin_s, fault, config) for fault in FAULTS]
            yield from map_in_processes(attempts, jobs, workers)

    settings = {"backend": backend, "options": list(assignments), "every_s": every_s}
    present("starts", f"{backend}: starts anywhere", rows(), COLUMNS, settings, keep)


def sequences(data: Path) -> Iterator[tuple[str, TrackSequence]]:
    """The recordings as tracks with truth."""
    parts = installed()
    clip = parts.open_dataset(data / "euroc/MH_01_easy_15s", options={"cameras": ["cam0"]})
    yield clip.name, tracked(clip, parts.create_detector("shi_tomasi"))
    for seed, (name, duration_s) in enumerate(FLIGHTS.items(), _FIRST_WORLD):
        bias_gyro_B, bias_accel_B = np.array([-0.002, 0.02, 0.08]), np.array([-0.02, 0.13, 0.07])
        flown = simulated_sequence(
            name, pixel_sigma=0.5, seed=seed, duration_s=duration_s, bias_gyro_B=bias_gyro_B, bias_accel_B=bias_accel_B
        )
        yield name, flown
    yield "april", april_sequence(data / "euroc_imu_april")


def faulty(calibration: Calibration, fault: str) -> Calibration:
    """What the estimator is told."""
    camera = calibration.cameras[0]
    kind, _, amount = fault.partition(" ")
    if kind == "none":
        return calibration
    value = float(amount.split()[0])
    if kind == "offset":
        return calibration.with_camera(0, time_offset_ns=camera.time_offset_ns + round(value * 1e6))
    if kind == "rotation":
        return calibration.with_camera(0, R_BC=camera.R_BC @ so3.exp(np.deg2rad(value) * _AXIS))
    return calibration.with_camera(0, model=camera.model.zoomed(1.0 + value / 100.0))


def attempts(starts: Starts) -> Row:
    """How all of them go, those left out before which there never is sufficient motion."""
    rows = []
    with threadpool_limits(1):
        for begin_s in starts.begin_s:
            begin_ns = int(starts.sequence.ground_truth.t_ns[0] + begin_s * 1e9)
            motion_s = sufficient_after_s(starts.sequence.ground_truth, begin_ns)
            if motion_s is not None:
                rows.append(attempt(starts, begin_ns, motion_s))
    return summary(starts.name, starts.fault, rows)


def attempt(starts: Starts, begin_ns: int, motion_s: float) -> Row:
    """One start, ``motion_s`` before motion is sufficient."""
    sequence, told, parts = starts.sequence, faulty(starts.sequence.calibration, starts.fault), installed()
    backend = parts.create_backend(starts.config.backend.name, starts.config.backend.options)
    odometry = Odometry(told, parts.create_detector("shi_tomasi"), backend, wait_ms=0.0, installed=parts)
    states: list[NavState] = []
    reset = False
    for measured in sequence.measurements():
        if measured.t_ns < begin_ns:
            continue
        frame = isinstance(measured, FrameTracks)
        if isinstance(measured, FrameTracks):
            steps = odometry.add_tracks(measured.undistorted(told.cameras[0].model))
        else:
            steps = odometry.add(measured)
        for step in steps:
            if step.estimate.status is Status.LOST:
                reset = True
            elif step.estimate.state is not None and not reset:
                states.append(step.estimate.state)
        since_s = (measured.t_ns - begin_ns) * 1e-9
        if frame and (
            (not states and since_s > motion_s + _LOOKED_AT_S)
            or (states and since_s > motion_s and (measured.t_ns - states[0].t_ns) * 1e-9 > _RESET_S)
            or reset
        ):
            break
    if not states:
        return {"after_s": np.inf, "scale": None, "reset": False}
    after_s = max((states[0].t_ns - begin_ns) * 1e-9 - motion_s, 0.0)
    moving_ns = begin_ns + round(motion_s * 1e9)
    moving = [state for state in states if state.t_ns >= moving_ns]
    return {"after_s": after_s, "scale": scale_of(moving, sequence.ground_truth), "reset": reset}


def sufficient_after_s(truth: Trajectory, begin_ns: int) -> float | None:
    """When, after ``begin_ns``, the body first has moved enough to begin from; None where it never has."""
    t_s = (truth.t_ns - begin_ns) * 1e-9
    for end in np.arange(0.5, t_s[-1] - 2.5, 0.1):
        window = (t_s >= max(end - _WITHIN_S, 0.0)) & (t_s <= end)
        p, R, t = truth.p_WB[window], truth.R_WB[window], t_s[window]
        if len(t) < 5:
            continue
        way = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
        v = np.gradient(p, t, axis=0)
        turned = so3.log(np.swapaxes(R[:1], -1, -2) @ R)
        changed = np.sqrt(((v - v.mean(axis=0)) ** 2).sum(axis=1).mean())
        spread = np.sqrt(((turned - turned.mean(axis=0)) ** 2).sum(axis=1).mean())
        if way > _GONE_M and changed > _CHANGED_M_S and spread > _TURNED_RAD:
            return float(end)
    return None


def scale_of(states: list[NavState], truth: Trajectory) -> float | None:
    """Of the path in the first two seconds of ``states``, 1 being right; None where they are not there."""
    part = [state for state in states if (state.t_ns - states[0].t_ns) * 1e-9 <= _SCALE_S]
    if not part or (part[-1].t_ns - part[0].t_ns) * 1e-9 < 0.8 * _SCALE_S:
        return None
    stamps, R, p = (np.array([getattr(s, name) for s in part]) for name in ("t_ns", "R_WB", "p_WB"))
    try:
        return evaluate(Trajectory(stamps, R, p), truth).scale
    except TrajectoryError:
        return None


def summary(name: str, fault: str, rows: list[Row]) -> Row:
    """What the starts of one recording with one fault come to."""
    if not rows:
        return {"recording": name, "fault": fault, "starts": 0}
    limit_s = 5.0 if fault.startswith("rotation") else 2.5
    after = np.array([row["after_s"] for row in rows])
    off = np.array([abs(row["scale"] - 1.0) for row in rows if row["scale"] is not None])
    resets = sum(bool(row["reset"]) for row in rows)
    begun = after[np.isfinite(after)]
    return {
        "recording": name,
        "fault": fault,
        "starts": len(rows),
        "in_time_percent": 100.0 * float((after <= limit_s).mean()),
        "after_s": float(np.median(begun)) if len(begun) else None,
        "slowest_s": float(begun.max()) if len(begun) else None,
        "never": int((~np.isfinite(after)).sum()),
        "bad": int((off > 0.05).sum()) + resets,
        "scale_percent": 100.0 * float(np.median(off)) if len(off) else None,
        "worst_scale_percent": 100.0 * float(off.max()) if len(off) else None,
        "resets": resets,
    }


if __name__ == "__main__":
    main()
