"""The real front-end, with each detector, along a recording whose motion is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.bench.detectors.degradations import Circumstances, Degradation
from vioframe.bench.detectors.entrants import Entrant
from vioframe.bench.detectors.leads import BASELINE, lead_of_shares
from vioframe.bench.detectors.tracks import coverage, lives
from vioframe.bench.epipolar import epipolar_errors_px
from vioframe.bench.processes import map_in_processes, single_threaded
from vioframe.bench.results import Row
from vioframe.errors import ConfigError, DatasetError
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.frontend.refill import GRID
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.interfaces import Dataset
from vioframe.io.synchronise import synchronise
from vioframe.io.trajectories import load_trajectory
from vioframe.parts import registry
from vioframe.parts.registry import Registry
from vioframe.types import NS_PER_S, Float, FrameSet, FrameTracks, ImuSegment

SURVIVAL_FRAMES = (5, 10, 20)
BASELINE_FRAMES = 5
INLIER_PX = 1.0

# Periods of the brightness, where that is what changes, and of the line along which motion blurs.
_SWING_S, _TURN_S = 2.0, 8.0


@dataclass(frozen=True, slots=True)
class Stretch:
    """The part of a recording to fly along, and the file of its true motion unless it brings that itself."""

    path: Path
    start_s: float = 0.0
    duration_s: float | None = None
    ground_truth: Path | None = None


@dataclass(frozen=True, slots=True)
class _Job:
    stretch: Stretch
    entrants: tuple[Entrant, ...]
    degradation: Degradation
    seed: int
    baseline: str


def fly_detectors(
    entrants: Sequence[Entrant],
    stretch: Stretch,
    degradations: Sequence[Degradation],
    *,
    seed: int,
    workers: int,
    baseline: str = BASELINE,
    on_flight: Callable[[int], None] = lambda count: None,
) -> list[Row]:
    """A row an entrant and degradation, the same whatever the number of ``workers``.

    Leads are over the entrant of the label ``baseline``; ``on_flight`` counts flights.
    """
    jobs = [_Job(stretch, tuple(entrants), degradation, seed, baseline) for degradation in degradations]
    parts = map_in_processes(_fly, jobs, workers, lambda part: on_flight(1))
    return [row for part in parts for row in part]


def check(stretch: Stretch, installed: Registry) -> str:
    """The recording's name; raises :class:`DatasetError` where it cannot be opened or brings no ground truth, and
    :class:`ConfigError` for a stretch that has no length."""
    if stretch.duration_s is not None and not 0.0 < stretch.duration_s < np.inf:
        raise ConfigError(f"--duration must be above 0, not {stretch.duration_s:g}")
    dataset = installed.open_dataset(stretch.path)
    truth_of(dataset, stretch)
    return dataset.name


def _fly(job: _Job) -> list[Row]:
    installed = registry.load()
    dataset = installed.open_dataset(job.stretch.path)
    options = FrontendOptions()
    incidents = {entrant.label: Incidents() for entrant in job.entrants}
    frontends = {
        entrant.label: Frontend(
            installed.create_detector(entrant.name, entrant.options),
            dataset.calibration,
            options,
            incidents[entrant.label],
        )
        for entrant in job.entrants
    }
    steps: dict[str, list[FrameTracks]] = {label: [] for label in frontends}
    with single_threaded():
        for imu, frames in degraded(dataset, job.stretch, job.degradation, job.seed):
            for label, frontend in frontends.items():
                steps[label].append(frontend.track(imu, frames, dataset.calibration))
    rows: list[Row] = [
        {
            "detector": label,
            "degradation": job.degradation.name,
            "level": job.degradation.level,
            **track_figures(tracks, dataset, truth_of(dataset, job.stretch)),
            "incidents": dict(incidents[label].counts),
        }
        for label, tracks in steps.items()
    ]
    baseline = next((row for row in rows if row["detector"] == job.baseline), None)
    return rows if baseline is None else [_with_leads(row, baseline) for row in rows]


def _with_leads(row: Row, baseline: Row) -> Row:
    """``row`` with its leads in survival over ``baseline``, of as many frames as both can tell."""
    if row is baseline:
        return row
    leads = {
        n: lead_of_shares(row["survival"][n], row["tracks"][n], baseline["survival"][n], baseline["tracks"][n])
        for n in row["survival"]
        if row["tracks"][n] and baseline["tracks"][n]
    }
    return {**row, "lead": {"survival": leads}}


def degraded(
    dataset: Dataset, stretch: Stretch, degradation: Degradation, seed: int
) -> Iterator[tuple[ImuSegment, FrameSet]]:
    """The packets of ``stretch``, each image degraded on its own.

    The direction of motion blur turns once every eight seconds, brightness swings once every two. Raises
    :class:`DatasetError` where there is no image.
    """
    packets = synchronise(
        dataset.measurements(),
        time_offset_ns=dataset.calibration.cameras[0].time_offset_ns,
        start_s=stretch.start_s,
        duration_s=stretch.duration_s,
        incidents=Incidents(),
    )
    begin_ns = None
    for number, (imu, frames) in enumerate(packets):
        begin_ns = frames.t_ns if begin_ns is None else begin_ns
        t_s = (frames.t_ns - begin_ns) / NS_PER_S
        circumstances = Circumstances(
            np.random.default_rng((seed, number)),
            direction_rad=2.0 * np.pi * t_s / _TURN_S,
            phase=0.5 - 0.5 * float(np.cos(2.0 * np.pi * t_s / _SWING_S)),
        )
        (image,) = frames.images
        assert image is not None
        image = degradation(image, circumstances)
        image.flags.writeable = False
        yield imu, FrameSet(frames.t_ns, (image,))
    if begin_ns is None:
        raise DatasetError(f"{dataset.name} has no image to process; check --start and --duration")


def track_figures(steps: Sequence[FrameTracks], dataset: Dataset, truth: Trajectory) -> Mapping[str, Any]:
    """What the tracks of a front-end amount to; what cannot be said of so few frames is None."""
    life = lives(steps)
    errors_px: Float = epipolar_errors_px(steps, truth, dataset.calibration, BASELINE_FRAMES)
    return {
        "frames": len(steps),
        "alive": float(np.mean([len(step.ids) for step in steps])),
        "survival": {str(n): life.share(n) for n in SURVIVAL_FRAMES},
        "tracks": {str(n): int(life.known[n]) if n < len(steps) else 0 for n in SURVIVAL_FRAMES},
        "median_life": life.median,
        "epipolar_inliers": float(np.mean(errors_px <= INLIER_PX)) if len(errors_px) else None,
        "epipolar_median_px": float(np.median(errors_px)) if len(errors_px) else None,
        "coverage": coverage(steps, dataset.calibration.cameras[0].model.resolution, GRID),
    }


def truth_of(dataset: Dataset, stretch: Stretch) -> Trajectory:
    """The true motion; raises :class:`DatasetError` where there is none."""
    truth = dataset.ground_truth if stretch.ground_truth is None else load_trajectory(stretch.ground_truth)
    if truth is None:
        raise DatasetError(
            f"{dataset.name} brings no ground truth to judge tracks by; name a file of it with --ground-truth"
        )
    return truth
