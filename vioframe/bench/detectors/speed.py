"""Frames a second of detectors, side by side."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd

from vioframe.bench.detectors.entrants import detect
from vioframe.bench.detectors.images import evenly, find_images, fit, frames_of, procedural_images, read_grey
from vioframe.cores import usable_cores
from vioframe.interfaces import Dataset, Detector
from vioframe.parts.config import LabelledPart
from vioframe.runs import machine
from vioframe.types import Image

RESOLUTION = (640, 480)
MAX_POINTS = 300


@runtime_checkable
class Placed(Protocol):
    """A detector that can run in several places and says in which: ``cpu`` or ``cuda``, and at what precision."""

    @property
    def device(self) -> str: ...

    @property
    def precision(self) -> str: ...


def pictures(
    count: int, *, folder: Path | None = None, recording: Dataset | None = None, seed: int = 0
) -> tuple[list[Image], str]:
    """At most ``count`` images, evenly from a ``folder`` or a ``recording`` or else drawn, and what they are."""
    if folder is not None:
        return [fit(read_grey(path), RESOLUTION) for path in evenly(find_images(folder), count)], folder.name
    if recording is not None:
        taken = [frames.images[0] for _, frames in frames_of(recording, count)]
        return [fit(image, RESOLUTION) for image in taken if image is not None], f"frames of {recording.name}"
    return procedural_images(count, RESOLUTION, seed), "drawn surfaces"


def time_detectors(
    ready: Sequence[tuple[LabelledPart, Detector]],
    images: Sequence[Image],
    rounds: int,
    max_points: int = MAX_POINTS,
    on_round: Callable[[int], None] = lambda count: None,
) -> pd.DataFrame:
    """A row a detector: median and quartiles of frames a second and ms, over every image in every round.

    The detectors take turns within a round, so that whatever else the machine does slows all of them alike. A round
    of a detector begins with a call that is not counted: caches, and threads that others left spinning, are then its
    own. A whole round before the first warms up. Raises :class:`PluginError` where a detector fails.
    """
    calls = []
    for number in range(rounds + 1):
        for entrant, detector in ready:
            detect(entrant, detector, images[-1], max_points)
            for image in images:
                begin = perf_counter()
                found = detect(entrant, detector, image, max_points)
                taken = perf_counter() - begin
                if number > 0:
                    calls.append((entrant.called, 1e3 * taken, len(found.xy)))
        on_round(1)
    every = pd.DataFrame(calls, columns=["detector", "ms", "keypoints"]).groupby("detector", sort=False)
    ms = every["ms"].quantile(np.array([0.25, 0.5, 0.75])).unstack().set_axis(["ms_low", "ms", "ms_high"], axis=1)
    fps = (1e3 / ms).set_axis(["fps_high", "fps", "fps_low"], axis=1)
    on = [f"{d.device}, {d.precision}" if isinstance(d, Placed) else "cpu" for _, d in ready]
    out = pd.concat([fps, ms, every["keypoints"].median()], axis=1).assign(calls=every.size())
    return out.loc[[entrant.called for entrant, _ in ready]].assign(on=on).rename_axis("detector").reset_index()


def speed_settings(images: str, image_count: int, rounds: int) -> dict[str, Any]:
    """What figures of speed are to be read with: ``images`` says what was looked at."""
    return {
        "images": images,
        "image_count": image_count,
        "rounds": rounds,
        "resolution": RESOLUTION,
        "max_points": MAX_POINTS,
        "devices": devices(),
    }


def devices() -> list[str]:
    """The processor with its threads, and the graphics cards that torch, where a detector has loaded it, can use."""
    import cv2

    found = [f"{machine.cpu_model()}, {usable_cores()} cores, OpenCV on {cv2.getNumThreads()} threads"]
    torch = sys.modules.get("torch")
    if torch is not None:
        found[0] += f", torch on {torch.get_num_threads()}"
        found += [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
    return found
