"""Detectors to compare, from what is written on the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vioframe.errors import ConfigError, PluginError, VioframeError
from vioframe.interfaces import Detector
from vioframe.parts.config import LabelledPart, parse_assignments, parse_part
from vioframe.parts.registry import DETECTOR, Registry, describe
from vioframe.types import Image, Keypoints

_DESCRIPTORS = "descriptors"
_TRACKS, _FULL = (f"keypointnet:weights={name}" for name in ("tracks", "full"))
# Which sees large images at half their size otherwise.
_WHOLE = "keypointnet:halvings=0"
_VARIANTS: Mapping[str, Mapping[str, Sequence[str]]] = {
    "speed": {"keypointnet": (_WHOLE, _TRACKS, _FULL)},
    # 10 px between corners, the default, suits tracking; it leaves out many that could be found again.
    "quality": {"shi_tomasi": ("shi_tomasi:min_distance_px=4",), "keypointnet": (_FULL,)},
}


@dataclass(frozen=True, slots=True)
class LineUp:
    """Those that can take part, and why the others, by label, cannot."""

    ready: tuple[tuple[LabelledPart, Detector], ...]
    absent: Mapping[str, str]


def everyone(installed: Registry, question: str) -> list[str]:
    """Specs of every installed detector, and of its variants that matter to ``question``: speed, quality, frontend."""
    variants = _VARIANTS.get(question, {})
    return [spec for name in installed.names(DETECTOR) for spec in (name, *variants.get(name, ()))]


def parse_entrants(
    specs: Sequence[str], assignments: Sequence[str], installed: Registry, *, describing: bool = False
) -> list[LabelledPart]:
    """An entrant for each of ``specs``, called by it; where ``describing``, those that can compute descriptors do.

    A spec is a name, or a name with options of its own: ``orb:levels=4,fast_threshold=10``.
    ``assignments``, texts such as ``sift.contrast_threshold=0.01``, go to every entrant of that name; the name may be
    left out where only one has such an option. Raises :class:`ConfigError` or :class:`PluginError`.
    """
    parts = {spec: parse_part(spec, DETECTOR, installed) for spec in specs}
    options = {part.name: installed.find(DETECTOR, part.name).options for part in parts.values()}
    shared: dict[str, dict[str, Any]] = {name: {} for name in options}
    for name, key, value in parse_assignments(assignments, options):
        shared[name][key] = value
    for spec, part in parts.items():
        # What is asked for must be right; what only lacks something, as weights, is absent and no error.
        if own := {**shared[part.name], **part.options}:
            installed.find(DETECTOR, part.name).validate(own)
        can = describing and any(option.name == _DESCRIPTORS for option in options[part.name])
        parts[spec] = part.model_copy(update={"options": {_DESCRIPTORS: True, **own} if can else own})
    return [LabelledPart(label=spec, **part.model_dump()) for spec, part in parts.items()]


def line_up(entrants: Sequence[LabelledPart], installed: Registry) -> LineUp:
    """Create each and have it look at one image; raises :class:`ConfigError` where none of them can."""
    ready: list[tuple[LabelledPart, Detector]] = []
    absent: dict[str, str] = {}
    probe = np.kron(np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8), np.ones((8, 8), np.uint8))
    for entrant in entrants:
        try:
            detector = installed.create_detector(entrant.name, entrant.options)
            detector.detect(probe, 10)
        except (Exception, SystemExit) as error:  # a plug-in may raise anything
            reason = str(error) if isinstance(error, VioframeError) else describe(error)
            absent[entrant.called] = " ".join(reason.split()).partition("; its options")[0]
        else:
            ready.append((entrant, detector))
    if not ready:
        reasons = "; ".join(f"{label}: {reason}" for label, reason in absent.items())
        raise ConfigError(f"no detector can take part: {reasons}")
    return LineUp(tuple(ready), absent)


def detect(entrant: LabelledPart, detector: Detector, image: Image, max_points: int) -> Keypoints:
    """What ``detector`` finds; raises :class:`PluginError` in the entrant's name where it fails."""
    try:
        return detector.detect(image, max_points)
    except Exception as error:
        raise PluginError(f"detector {entrant.called} failed: {describe(error)}; leave it out or repair it") from error
