"""The real front-end, with each detector, along a recording whose motion is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vioframe.bench.detectors.degradations import Circumstances, Degradation
from vioframe.bench.detectors.tables import BASELINE, CONFIDENCE
from vioframe.bench.processes import installed, map_in_processes, single_threaded
from vioframe.errors import ConfigError, DatasetError
from vioframe.evaluation.epipolar import epipolar_errors_px
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.frontend.refill import GRID
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.interfaces import Dataset
from vioframe.io.synchronise import synchronise
from vioframe.io.trajectories import load_trajectory
from vioframe.parts.config import LabelledPart
from vioframe.types import NS_PER_S, Float, FrameSet, FrameTracks, ImuSegment, Int

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


def fly_detectors(
    entrants: Sequence[LabelledPart],
    stretch: Stretch,
    degradations: Sequence[Degradation],
    *,
    seed: int,
    workers: int,
    baseline: str = BASELINE,
    on_flight: Callable[[int], None] = lambda count: None,
) -> pd.DataFrame:
    """A row an entrant and degradation, the same whatever the number of ``workers``.

    ``lead_survival_N`` are leads over the entrant of the label ``baseline``, with half the width of their 95 %
    interval, every track counting as one that goes its own way; ``on_flight`` counts flights.
    """
    parts = map_in_processes(
        partial(_fly, stretch, tuple(entrants), seed), degradations, workers, lambda part: on_flight(1)
    )
    rows = pd.DataFrame([row for part in parts for row in part])
    return _with_leads(rows, baseline) if (rows["detector"] == baseline).any() else rows


def check(stretch: Stretch) -> str:
    """The recording's name; raises :class:`DatasetError` where it cannot be opened or brings no ground truth, and
    :class:`ConfigError` for a stretch that has no length."""
    if stretch.duration_s is not None and not 0.0 < stretch.duration_s < np.inf:
        raise ConfigError(f"--duration must be above 0, not {stretch.duration_s:g}")
    dataset = installed().open_dataset(stretch.path)
    truth_of(dataset, stretch)
    return dataset.name


def _fly(
    stretch: Stretch, entrants: Sequence[LabelledPart], seed: int, degradation: Degradation
) -> list[dict[str, Any]]:
    dataset = installed().open_dataset(stretch.path)
    incidents = {entrant.called: Incidents() for entrant in entrants}
    frontends = {}
    for each in entrants:
        detector = installed().create_detector(each.name, each.options)
        frontends[each.called] = Frontend(detector, dataset.calibration, FrontendOptions(), incidents[each.called])
    steps: dict[str, list[FrameTracks]] = {label: [] for label in frontends}
    with single_threaded():
        for imu, frames in degraded(dataset, stretch, degradation, seed):
            for label, frontend in frontends.items():
                steps[label].append(frontend.track(imu, frames, dataset.calibration))
    truth = truth_of(dataset, stretch)
    return [
        {
            "detector": label,
            **degradation.columns,
            **track_figures(tracks, dataset, truth),
            "incidents": ", ".join(f"{count} {kind}" for kind, count in incidents[label].counts.items()),
        }
        for label, tracks in steps.items()
    ]


def _with_leads(rows: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """``rows`` with their leads in survival over ``baseline``; missing where either cannot tell."""
    of_baseline = rows[["degradation", "level"]].merge(rows[rows["detector"] == baseline], how="left")
    leads = {}
    for n in SURVIVAL_FRAMES:
        shares = [each[f"survival_{n}"].astype(float) for each in (rows, of_baseline)]
        tracks = [each[f"tracks_{n}"] for each in (rows, of_baseline)]
        lead = (shares[0] - shares[1]).where(rows["detector"] != baseline)
        variance = sum(share * (1.0 - share) / count for share, count in zip(shares, tracks, strict=True))
        leads[f"lead_survival_{n}"] = lead
        leads[f"lead_survival_{n}_half_width"] = (CONFIDENCE * variance**0.5).where(lead.notna())
    return rows.assign(**leads)


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
    errors_px: Float = epipolar_errors_px(steps, truth, dataset.calibration, BASELINE_FRAMES)
    return {
        "frames": len(steps),
        "alive": float(np.mean([len(step.ids) for step in steps])),
        **survival(*lives(steps)),
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


def lives(steps: Sequence[FrameTracks]) -> tuple[Int, Int]:
    """How long the tracks of N successive frames live, one at least.

    Returns (N,) tracks that were still there n = 0 .. N - 1 frames after they were born, and (N,) tracks that were born
    early enough to be seen for so long. An id that is gone does not come back, as
    :class:`vioframe.frontend.Frontend` promises.
    """
    count = len(steps)
    ids = np.concatenate([step.ids for step in steps])
    frame = np.repeat(np.arange(count), [len(step.ids) for step in steps])
    _, first, lived = np.unique(ids, return_index=True, return_counts=True)
    born = frame[first]  # unique() gives the first place of each id, and frames ascend
    known = np.cumsum(np.bincount(born, minlength=count))[::-1]  # n frames before the end, or earlier
    # Of those that lived n + 1 frames or longer, all were born early enough.
    alive = np.cumsum(np.bincount(lived - 1, minlength=count)[::-1])[::-1]
    return alive, known


def survival(alive: Int, known: Int) -> dict[str, Any]:
    """What :func:`lives` amount to: shares of tracks that live for so many frames, and the median life.

    That is the number of frames after which fewer than half are alive. None is what is never seen.
    """
    figures: dict[str, Any] = {}
    for n in SURVIVAL_FRAMES:
        of = int(known[n]) if n < len(known) else 0
        figures |= {f"survival_{n}": float(alive[n] / of) if of else None, f"tracks_{n}": of}
    below = np.flatnonzero(2 * alive < known)
    return figures | {"median_life": int(below[0]) if len(below) else None}


def coverage(steps: Sequence[FrameTracks], resolution: tuple[int, int], grid: tuple[int, int]) -> float:
    """Share of the cells of a ``grid`` (rows, columns) over the image that hold a point, mean over the frames."""
    rows, columns = grid
    shares = []
    for step in steps:
        cell = np.floor((step.xy + 0.5) / np.array(resolution) * (columns, rows)).astype(np.int64)
        cell = np.clip(cell, 0, (columns - 1, rows - 1))
        shares.append(len(np.unique(cell[:, 1] * columns + cell[:, 0])) / (rows * columns))
    return float(np.mean(shares))
