"""Frames a second of detectors, side by side."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np

from vioframe.bench.detectors.entrants import Entrant, detect
from vioframe.bench.processes import usable_cores
from vioframe.interfaces import Detector
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


def time_detectors(
    ready: Sequence[tuple[Entrant, Detector]],
    images: Sequence[Image],
    rounds: int,
    max_points: int = MAX_POINTS,
    on_round: Callable[[int], None] = lambda count: None,
) -> list[dict[str, Any]]:
    """A row a detector: median and quartiles of frames a second and ms, over every image in every round.

    The detectors take turns within a round, so that whatever else the machine does slows all of them alike. A round
    of a detector begins with a call that is not counted: caches, and threads that others left spinning, are then its
    own. A whole round before the first warms up. Raises :class:`PluginError` where a detector fails.
    """
    ms: list[list[float]] = [[] for _ in ready]
    keypoints: list[list[int]] = [[] for _ in ready]
    for number in range(rounds + 1):
        for k, (entrant, detector) in enumerate(ready):
            detect(entrant, detector, images[-1], max_points)
            for image in images:
                begin = perf_counter()
                found = detect(entrant, detector, image, max_points)
                taken = perf_counter() - begin
                if number > 0:
                    ms[k].append(1e3 * taken)
                    keypoints[k].append(len(found.xy))
        on_round(1)
    rows = []
    for k, (entrant, detector) in enumerate(ready):
        low, median, high = (float(q) for q in np.quantile(ms[k], [0.25, 0.5, 0.75]))
        fps = {"fps": 1e3 / median, "fps_low": 1e3 / high, "fps_high": 1e3 / low}
        on = f"{detector.device}, {detector.precision}" if isinstance(detector, Placed) else "cpu"
        rest = {"keypoints": float(np.median(keypoints[k])), "calls": len(ms[k]), "on": on}
        rows.append({"detector": entrant.label, **fps, "ms": median, "ms_low": low, "ms_high": high, **rest})
    return rows


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
