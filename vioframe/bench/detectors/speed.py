"""Frames a second of detectors, side by side."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd

from vioframe.bench.detectors.entrants import detect
from vioframe.bench.detectors.images import evenly, find_images, fit, frames_of, procedural_images, read_grey
from vioframe.cores import usable_cores
from vioframe.errors import DatasetError
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
    count: int,
    *,
    drawn: bool = True,
    folder: Path | None = None,
    recording: Dataset | None = None,
    seed: int = 0,
) -> dict[str, list[Image]]:
    """At most ``count`` images of each kind by what they are: ``drawn``, of a ``folder`` and of a ``recording``.

    Raises :class:`DatasetError` where there are none.
    """
    found = {"drawn surfaces": procedural_images(count, RESOLUTION, seed)} if drawn else {}
    if folder is not None:
        taken = evenly(find_images(folder), count)
        found[f"photographs of {folder.resolve().name}"] = [fit(read_grey(path), RESOLUTION) for path in taken]
    if recording is not None:
        seen = [frames.images[0] for _, frames in frames_of(recording, count)]
        own = found[f"frames of {recording.name}"] = [fit(image, RESOLUTION) for image in seen if image is not None]
        if not own:
            raise DatasetError(f"{recording.name} has no image of its first camera to time detectors on")
    return found


def time_detectors(
    ready: Sequence[tuple[LabelledPart, Detector]],
    images: Mapping[str, Sequence[Image]],
    rounds: int,
    max_points: int = MAX_POINTS,
    on_round: Callable[[int], None] = lambda count: None,
) -> pd.DataFrame:
    """A row for each kind of ``images`` and detector: median and quartiles of frames a second and ms, over all calls.

    ``images`` are by what they are: on some, some detectors look at many more candidates than on others. The detectors
    take turns within a round, so that whatever else the machine does slows all of them alike. A round of a detector
    begins with a call that is not counted: caches, and threads that others left spinning, are then its own. A whole
    round before the first warms up. Raises :class:`PluginError` where a detector fails.
    """
    looked_at = [(kind, image) for kind, own in images.items() for image in own]
    calls = []
    for number in range(rounds + 1):
        for entrant, detector in ready:
            detect(entrant, detector, looked_at[-1][1], max_points)
            for kind, image in looked_at:
                begin = perf_counter()
                found = detect(entrant, detector, image, max_points)
                taken = perf_counter() - begin
                if number > 0:
                    calls.append((kind, entrant.called, 1e3 * taken, len(found.xy)))
        on_round(1)
    case = ["images", "detector"]
    every = pd.DataFrame(calls, columns=[*case, "ms", "keypoints"]).groupby(case, sort=False)
    ms = every["ms"].quantile(np.array([0.25, 0.5, 0.75])).unstack().set_axis(["ms_low", "ms", "ms_high"], axis=1)
    fps = (1e3 / ms).set_axis(["fps_high", "fps", "fps_low"], axis=1)
    out = pd.concat([fps, ms, every["keypoints"].median()], axis=1).assign(calls=every.size())
    out = out.loc[[(kind, entrant.called) for kind in images for entrant, _ in ready]].reset_index()
    on = {e.called: f"{d.device}, {d.precision}" if isinstance(d, Placed) else "cpu" for e, d in ready}
    counts = {kind: len(own) for kind, own in images.items()}
    return out.assign(on=out["detector"].map(on), image_count=out["images"].map(counts))


def speed_settings(rounds: int) -> dict[str, Any]:
    """What figures of speed are to be read with."""
    return {
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
