"""How the page's plots look: one colour a detector and one kind of line a back-end, in every plot alike."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.report import style
from vioframe.report.suite.page_blocks import Picture
from vioframe.types import Float

if TYPE_CHECKING:
    from plotly.basedatatypes import BaseTraceType

TRUTH_COLOUR = str(style.TRUTH["color"])
BAND_COLOUR = "#009e73"
"""Of the range that errors are meant to stay in: no detector's, as it is only ever drawn as an area."""

DARK = {
    "#0072b2": "#4aa3e0",
    "#d55e00": "#f07b2a",
    "#009e73": "#2fc294",
    "#cc79a7": "#e093bd",
    "#e69f00": "#f2b632",
    "#56b4e9": "#a4dcff",
    TRUTH_COLOUR: "#6b7480",
}
"""What the colours become on a dark page, where the same ones would be too dim to tell apart."""

_DASHES = ("solid", "dash", "dot", "dashdot")
_FILLS = (0.85, 0.25, 0.5, 0.1)


@dataclass(frozen=True)
class Look:
    """Contenders in the order of the suite, and what tells them apart.

    The colour says which detector it is, or which back-end where there is one detector alone.
    """

    detectors: Sequence[str]
    backends: Sequence[str]

    def colour(self, detector: str, backend: str) -> str:
        one = len(self.detectors) < 2
        return style.colour(self.backends.index(backend) if one else self.detectors.index(detector)).lower()

    def line(self, detector: str, backend: str, width: float = 1.8) -> dict[str, Any]:
        """Of Plotly's lines."""
        dash = _DASHES[0 if len(self.detectors) < 2 else self.backends.index(backend) % len(_DASHES)]
        return {"color": self.colour(detector, backend), "dash": dash, "width": width}

    def opacity(self, backend: str) -> float:
        """Of areas, which have no dashes to tell back-ends apart by."""
        return _FILLS[self.backends.index(backend) % len(_FILLS)]

    def name(self, detector: str, backend: str) -> str:
        """In legends and tables; what all contenders share is left out."""
        if len(self.detectors) < 2:
            return backend
        return detector if len(self.backends) < 2 else f"{detector} · {backend}"

    def meta(self, detector: str, backend: str) -> dict[str, str]:
        """By which the page's legends and filters know a trace."""
        return {"series": self.name(detector, backend), "detector": detector, "backend": backend}


def picture(traces: Sequence[BaseTraceType], layout: Mapping[str, Any]) -> Picture:
    """Checked by Plotly, and encoded as it reads it fastest. How it looks on the page is up to the page's script."""
    import plotly.graph_objects as go

    tree = json.loads(str(go.Figure(list(traces), go.Layout(template="none", **layout)).to_json()))
    del tree["layout"]["template"]
    return Picture(tree["data"], tree["layout"])


def panels(titles: Sequence[str], x_title: str, gap: float = 0.07, **y: Any) -> dict[str, Any]:
    """Layout of panels above each other that share their x axis; the k-th one's traces are on ``axes(k)``."""
    height = (1.0 - gap * (len(titles) - 1)) / len(titles)
    layout: dict[str, Any] = {}
    for k, title in enumerate(titles):
        bottom, last = (len(titles) - 1 - k) * (height + gap), k == len(titles) - 1
        suffix = "" if k == 0 else str(k + 1)
        domain = [max(0.0, bottom), min(1.0, bottom + height)]
        layout[f"yaxis{suffix}"] = {"domain": domain, "anchor": f"x{suffix}", "title": {"text": title}, **y}
        layout[f"xaxis{suffix}"] = {
            "anchor": f"y{suffix}",
            "showticklabels": last,
            "title": {"text": x_title if last else ""},
            **({} if k == 0 else {"matches": "x"}),
        }
    return layout


def axes(k: int) -> dict[str, str]:
    """Which axes the traces of the k-th of :func:`panels` belong to."""
    suffix = "" if k == 0 else str(k + 1)
    return {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}


def compact(values: Float) -> Float:
    """As many digits as a screen can show, in half of the page's bytes."""
    return np.asarray(values, dtype=np.float32)
