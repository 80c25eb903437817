"""How every figure looks: colours that the colour-blind tell apart, sizes that read from the back of a room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from vioframe.runs.evaluated import Evaluated

# Okabe and Ito's palette, strongest contrasts first; grey is the ground truth's.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
TRUTH_COLOUR = "#b0b0b0"
DASHES = ("solid", "dash", "dot", "dashdot")
SERIES = " · "
"""Between detector and back-end, where a series is called by both."""

RC: Mapping[Any, Any] = MappingProxyType(
    {
        "font.size": 12,
        "axes.titlesize": 13,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.labelsize": 12,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": "#d9d9d9",
        "grid.linewidth": 0.6,
        "lines.linewidth": 1.6,
        "legend.frameon": False,
        "legend.fontsize": 11,
        "figure.dpi": 100,
        "svg.hashsalt": "vioframe",
        "svg.fonttype": "none",
    }
)


def colour(i: int) -> str:
    """The i-th colour of the palette, which repeats."""
    return _COLOURS[i % len(_COLOURS)]


def looks(runs: Sequence[Evaluated]) -> list[tuple[str, str]]:
    """Colour and dashes of each run. What loop closure made of one has its colour, as has who is beyond the palette:
    their dashes differ."""
    out: list[tuple[str, str]] = []
    number = -1
    for run in runs:
        number += not run.loop_closed
        dash = 2 * (max(number, 0) // len(_COLOURS)) + run.loop_closed
        out.append((colour(max(number, 0)), DASHES[dash % len(DASHES)]))
    return out
