"""How every figure looks: colours that the colour-blind tell apart, sizes that read from the back of a room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

# Okabe and Ito's palette, strongest contrasts first; grey is the ground truth's.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
PALETTE_SIZE = len(_COLOURS)
_DASHES = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 2, 1, 2)))

# A broad grey ribbon stays visible below any number of lines that follow it.
TRUTH: Mapping[str, Any] = MappingProxyType({"color": "#b0b0b0", "lw": 5.0, "label": "ground truth"})

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
        "savefig.dpi": 160,
        "svg.hashsalt": "vioframe",
        "svg.fonttype": "none",
    }
)


def line(i: int) -> dict[str, Any]:
    """Colour and dashes of the i-th run; runs beyond the palette differ by their dashes."""
    return {"color": colour(i), "ls": _DASHES[(i // PALETTE_SIZE) % len(_DASHES)]}


def colour(i: int) -> str:
    """The i-th colour of the palette, which repeats."""
    return _COLOURS[i % PALETTE_SIZE]


def caption(figure: Any, text: str) -> None:
    """A line under the figure that says how to read it."""
    figure.supxlabel(text, fontsize=10, color="#555555", x=0.01, ha="left")


def legend_above(figure: Any, handles: Sequence[Any]) -> None:
    """One legend for all panels, above them, so that it hides no data."""
    labels = [handle.get_label() for handle in handles]
    figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 4), borderaxespad=0.2)
