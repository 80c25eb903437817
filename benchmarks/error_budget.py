"""Where the error of an estimate comes from: a flight estimated again and again, each time with one cause taken away.

    python benchmarks/error_budget.py [--record] [--flight MH_02_easy] [--world 0] [--duration 60]

A recorded flight is rendered, and its points are followed as in any run. The landmark of a point lies where the ray of
its first sighting meets the world; so where it truly is in every later image is known, and with it the tracker's error.
Then the back-end has the same points again:

    as flown          as they were followed, with the IMU that was recorded
    white noise       where they truly are, with white noise as large as the tracker's error
    exact points      where they truly are
    published path    seen from the path as it has been published, not from the one that the IMU felt
    specified IMU     along a smooth path, with readings as noisy as the calibration says, and biases that wander so
    exact IMU         there, with readings that are exact
    known rig         with the calibration, which is exact here, not estimated
    true start        from the true state at the first frame
    as assumed        white noise, specified IMU, known rig and true start at once: what the estimator takes for granted

Everything but what a row names is as flown. Nothing is tuned on the flights of other benchmarks' targets: by default
this flies MH_02, MH_03 and V1_01.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from common import benchmark, present, tracked
from threadpoolctl import threadpool_limits

from vioframe.arrays import Float, Int
from vioframe.bench import Row, backend_row, run_backend
from vioframe.bench.suites.sources import EUROC
from vioframe.cores import usable_cores
from vioframe.evaluation.tracks import landmarks_of
from vioframe.geometry.trajectory import Trajectory
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, PartConfig
from vioframe.parts.registry import Registry
from vioframe.simulation import TrackSequence
from vioframe.simulation.config import SimulationConfig, complete
from vioframe.simulation.flights import fit_flight
from vioframe.simulation.recording import SimulatedRecording
from vioframe.simulation.scenario import Scenario, fly, load_euroc
from vioframe.simulation.tracks import cut_segments
from vioframe.types import NS_PER_S, CameraOnBody, FrameTracks, ImuNoise

FLIGHTS = ("MH_02_easy", "MH_03_medium", "V1_01_easy")
WORLDS = (0, 1)
# What is off by more, px, slid onto something else or is no error of following: counted, not made white noise of.
OUTLIER_PX = 5.0
# Of a true start: rad, m, m/s, rad/s, m/s^2.
START_SIGMA = np.repeat([0.002, 0.001, 0.01, 0.001, 0.02], 3)
KNOWN_RIG = {"calibrate_extrinsics": False, "calibrate_time_offset": False, "calibrate_intrinsics": False}
COLUMNS = {
    "sequence": "",
    "world": "d",
    "case": "",
    "ate_mm": ".0f",
    "of_flown": ".2f",
    "orientation_deg": ".2f",
    "scale": ".4f",
    "nees.orientation": ".1f",
    "nees.position": ".1f",
    "completion": ".1%",
    "resets": "d",
}


@dataclass(frozen=True)
class Case:
    """What is otherwise than as flown.

    The points are ``flown``, ``white`` or ``exact``; the path is ``felt``, ``published`` or ``smooth``, and along the
    smooth one the IMU is as ``specified`` or ``exact`` instead of ``recorded``.
    """

    name: str
    points: str = "flown"
    path: str = "felt"
    imu: str = "recorded"
    options: Mapping[str, Any] | None = None
    true_start: bool = False


EXACT_POINTS = Case("exact points", points="exact")
CASES = (
    Case("as flown"),
    Case("white noise", points="white"),
    EXACT_POINTS,
    Case("published path", path="published"),
    Case("specified IMU", path="smooth", imu="specified"),
    Case("exact IMU", path="smooth", imu="exact"),
    Case("known rig", options=KNOWN_RIG),
    Case("true start", true_start=True),
    Case("as assumed", points="white", path="smooth", imu="specified", options=KNOWN_RIG, true_start=True),
)


@dataclass(frozen=True)
class Followed:
    """What the tracker made of a flight: a :class:`FrameTracks` a frame, and the landmark of each sighting.

    ``p_WF`` holds (N, 3) m a frame, and ``error_px`` (N, 2) how far off the true place each was seen.
    """

    tracks: tuple[FrameTracks, ...]
    p_WF: tuple[Float, ...]
    error_px: tuple[Float, ...]

    def sigma_px(self) -> tuple[float, float]:
        """Root mean square along an axis of what is no outlier, and the part of the sightings that are."""
        error_px = np.concatenate(self.error_px)
        out = np.linalg.norm(error_px, axis=1) > OUTLIER_PX
        return float(np.sqrt(np.mean(error_px[~out] ** 2))), float(out.mean())


@benchmark
@click.option("--flight", "flights", multiple=True, default=FLIGHTS, show_default=True)
@click.option("--world", "worlds", multiple=True, type=int, default=WORLDS, show_default=True)
@click.option("--duration", "duration_s", default=60.0, show_default=True, help="Seconds flown of each.")
def main(
    data: Path,
    backend: str,
    assignments: tuple[str, ...],
    keep: bool,
    flights: tuple[str, ...],
    worlds: tuple[int, ...],
    duration_s: float,
) -> None:
    """The error of a back-end on rendered flights, cause by cause."""
    installed = registry.load()
    config = configuration.override(Config(backend=PartConfig(name=backend)), installed, assignments)

    def rows() -> Iterator[Row]:
        for flight in flights:
            for world in worlds:
                folder, start_s = data / "euroc_imu_gt" / flight, EUROC[flight].start_s
                settings = {"recorded": folder, "start_s": start_s, "duration_s": duration_s, "seed": world}
                simulation = complete(SimulationConfig.model_validate(settings), installed)
                recording = SimulatedRecording(simulation, installed, usable_cores())
                detector = installed.create_detector(config.detector.name, config.detector.options)
                sequence = tracked(recording, detector, config.frontend_options)
                followed = with_landmarks([tracks for _, tracks in sequence.packets], recording)
                flown_mm = None
                for case in CASES:
                    row = estimated(case, followed, recording, config, installed, world)
                    flown_mm = flown_mm or row.get("ate_mm")
                    click.echo(f"{flight}, world {world}, {case.name}: {row.get('ate_mm', np.nan):.0f} mm", err=True)
                    yield {**row, "of_flown": row["ate_mm"] / flown_mm if "ate_mm" in row and flown_mm else None}

    about = {"backend": backend, "options": list(assignments), "duration_s": duration_s, "outlier_px": OUTLIER_PX}
    present("error_budget", f"{backend}: where the error comes from", rows(), COLUMNS, about, keep)


def with_landmarks(tracks: Sequence[FrameTracks], recording: SimulatedRecording) -> Followed:
    """The ``tracks`` of a camera that flew in the world of ``recording``, with the landmarks behind them."""
    (camera,) = recording.calibration.cameras
    R_WB, p_WB = recording.scenario.motion(np.array([frame.t_ns for frame in tracks]))[:2]
    known = landmarks_of(tracks, *camera.pose(R_WB, p_WB), recording.world.mesh.corners)
    kept, landmarks, errors = [], [], []
    for frame, R, p in zip(tracks, R_WB, p_WB, strict=True):
        p_WF = known[frame.ids]
        xy, ahead = pixels(camera, R, p, p_WF)
        kept.append(frame.only(ahead))
        landmarks.append(p_WF[ahead])
        errors.append(frame.xy[ahead] - xy[ahead])
    return Followed(tuple(kept), tuple(landmarks), tuple(errors))


def pixels(camera: CameraOnBody, R_WB: Float, p_WB: Float, p_WF: Float) -> tuple[Float, np.ndarray]:
    """(N, 2) px at which a body there sees landmarks (N, 3) m, and which lie ahead (N,)."""
    p_C = ((p_WF - p_WB) @ R_WB - camera.p_BC) @ camera.R_BC
    ahead = np.isfinite(p_C).all(axis=1) & (p_C[:, 2] > 0.1)
    return camera.model.project(np.where(ahead[:, None], p_C, [0.0, 0.0, 1.0])), ahead


def estimated(
    case: Case, followed: Followed, recording: SimulatedRecording, config: Config, installed: Registry, seed: int
) -> Row:
    """The flight as the ``case`` has it, estimated."""
    sequence = _sequence(case, followed, recording, seed)
    start = None
    if case.true_start:
        sequence = replace(sequence, packets=sequence.packets[1:])
        start = replace(sequence.true_states[1], cov=np.diag(START_SIGMA**2))
    options = {**config.backend.options, **(case.options or {})}
    backend = installed.create_backend(config.backend.name, options)
    with threadpool_limits(1):
        run = run_backend(sequence, backend, config.estimation_options, start)
    row = backend_row(sequence, run)
    sigma_px, outliers = followed.sigma_px()
    about: Row = {"case": case.name, "world": seed, "tracker_px": sigma_px, "outlier_part": outliers}
    if "ate_m" in row:
        about["ate_mm"] = 1e3 * row["ate_m"]
    return {**row, **about}


def _sequence(case: Case, followed: Followed, recording: SimulatedRecording, seed: int) -> TrackSequence:
    frames_ns = np.array([frame.t_ns for frame in followed.tracks])
    calibration, scenario = recording.calibration, recording.scenario
    if case.path == "published":
        folder = recording.config.recorded
        assert folder is not None
        published = load_euroc(folder, start_s=recording.config.start_s, duration_s=recording.config.duration_s)
        scenario = replace(scenario, motion=published.motion)
    elif case.path == "smooth":
        noise = calibration.imu if case.imu == "specified" else None
        scenario = _flown(scenario, frames_ns, noise, calibration.imu.rate_hz, np.random.default_rng([seed, 2]))
    R_WB, p_WB, _ = scenario.motion(frames_ns)
    segments = cut_segments(scenario.imu_ns, scenario.gyro_B, scenario.accel_B, frames_ns)
    rng, (sigma_px, _) = np.random.default_rng([seed, 1]), followed.sigma_px()
    packets = []
    frames = zip(segments, R_WB, p_WB, followed.tracks, followed.p_WF, followed.error_px, strict=True)
    for imu, R, p, tracks, p_WF, error_px in frames:
        xy, ahead = pixels(calibration.cameras[0], R, p, p_WF)
        if case.points == "flown":
            xy = xy + error_px
        elif case.points == "white":
            xy = xy + rng.normal(0.0, sigma_px, xy.shape)
        packets.append((imu, replace(tracks, xy=xy).only(ahead).undistorted(*calibration.lenses).finite()))
    truth = Trajectory(frames_ns, R_WB, p_WB)
    return TrackSequence(recording.scenario.name, calibration, tuple(packets), truth, scenario.states_at(frames_ns))


def _flown(
    felt: Scenario, frames_ns: Int, noise: ImuNoise | None, rate_hz: float, rng: np.random.Generator
) -> Scenario:
    """A spline along the path, from the first of the frames to the last, and the readings of a body that flies it."""
    after_s = (frames_ns - felt.truth.t_ns[0]) / NS_PER_S
    flight = fit_flight(felt.truth, after_s[0], after_s[-1] - after_s[0])
    frames_s = after_s - after_s[0]
    imu_s = np.arange(int(frames_s[-1] * rate_hz) + 2) / rate_hz
    return fly(
        flight, "", rng, frames_s=frames_s, imu_s=imu_s, imu_rate_hz=rate_hz, noise=noise, begin_ns=int(frames_ns[0])
    )


if __name__ == "__main__":
    main()
