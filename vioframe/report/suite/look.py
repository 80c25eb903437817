"""How contenders look in every figure of a suite: a colour a detector, dashes and a marker a back-end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any, Self

from vioframe.report.style import caption, colour
from vioframe.report.suite.statistics import Group

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DASHES = ("-", (0, (5, 1.6)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
_MARKERS = ("o", "s", "^", "D")
_LETTERS_AN_INCH = 12.6


@dataclass(frozen=True, slots=True)
class Look:
    """Detectors and back-ends in the order of the suite, which settles what they look like."""

    detectors: tuple[str, ...]
    backends: tuple[str, ...]

    @classmethod
    def of(cls, found: Sequence[Group]) -> Self:
        detectors = dict.fromkeys(group.cell.detector for group in found)
        return cls(tuple(detectors), tuple(dict.fromkeys(group.cell.backend for group in found)))

    def colour(self, detector: str) -> str:
        return colour(self.detectors.index(detector))

    def dashes(self, backend: str) -> Any:
        return _DASHES[self.backends.index(backend) % len(_DASHES)]

    def marker(self, backend: str) -> str:
        return _MARKERS[self.backends.index(backend) % len(_MARKERS)]

    def handles(self, of_backends: bool = True) -> list[Any]:
        """Entries of a legend: the detectors by colour, then, where there are several, the back-ends by dashes."""
        from matplotlib.lines import Line2D

        out = [Line2D([], [], color=self.colour(name), lw=3, label=name) for name in self.detectors]
        if of_backends and len(self.backends) > 1:
            look: dict[str, Any] = {"color": "#444444", "lw": 1.8}
            out += [
                Line2D([], [], ls=self.dashes(name), marker=self.marker(name), ms=6, label=name, **look)
                for name in self.backends
            ]
        return out


def legend(figure: Figure, handles: Sequence[Any]) -> None:
    """One legend for all panels, above them, in as few lines as fit."""
    names = [handle.get_label() for handle in handles]
    columns = int(figure.get_figwidth() / (0.75 + max(map(len, names)) / 12.5))
    figure.legend(handles, names, loc="outside upper left", ncols=min(max(columns, 1), len(names)), borderaxespad=0.2)


def log_scale(ax: Any) -> None:
    """A logarithmic axis upwards that says 0.1, 0.2, 0.5 and not powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter

    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())


def explain(figure: Figure, text: str) -> None:
    """A caption below the figure, folded to its width."""
    caption(figure, fill(" ".join(text.split()), int(_LETTERS_AN_INCH * figure.get_figwidth())))
