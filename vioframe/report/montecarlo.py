"""A Monte Carlo as a table for the terminal, and as a folder of files.

- ``montecarlo.json``: settings, machine, figures by back-end and by seed
- ``nees.csv``: averages over the trials, over time
- ``nees_FLIGHT.png``: the same, drawn with the bounds of an honest filter
- ``trials.png``: the errors of every trial
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.evaluation.consistency import PARTS, AverageNees, Outcome
from vioframe.types import NS_PER_S

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

MARKER = "montecarlo.json"
"""The file by which a folder is known as that of a Monte Carlo."""

_UNKNOWN = "–"
_COLOURS = {"consistent": "green", "overconfident": "red", "pessimistic": "yellow"}


def to_rich(outcomes: Sequence[Outcome]) -> Table:
    """A table with a column a back-end and flight."""
    from rich.table import Table
    from rich.text import Text

    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("")
    for outcome in outcomes:
        table.add_column(Text(f"{outcome.name}\n{outcome.flight}"), justify="right", overflow="fold")

    def section(title: str, rows: Mapping[str, Callable[[Outcome], Text | str]]) -> None:
        table.add_row(Text(title, style="bold"))
        for label, cell in rows.items():
            table.add_row(Text(f"  {label}"), *(cell(outcome) for outcome in outcomes))
        table.add_section()

    section(
        "Trials",
        {
            "flown": lambda o: str(len(o.trials)),
            "failed": _failures,
            "resets": lambda o: str(o.total("resets")),
            "initialised after [s]": lambda o: _number(o.mean("initialised_s"), ".2f"),
            "completion after that [%]": lambda o: _number(o.mean("completion"), ".1f", 100.0),
        },
    )
    section(
        "RMSE, position + yaw aligned (worst)",
        {
            "position (ATE) [m]": lambda o: _error(o, "ate_m", ".3f"),
            "position [% of path]": lambda o: _error(o, "percent", ".3f"),
            "orientation [deg]": lambda o: _error(o, "orientation_deg", ".2f"),
        },
    )
    section(
        "NEES, mean [95 % if honest]",
        {f"{part}, ideally {dof}": _mean_nees(part) for part, dof in PARTS.items()},
    )
    section("NEES over its ideal (instants in bounds)", {part: _nees_per_axis(part) for part in PARTS})
    section("Time", {"back-end, ms a frame": lambda o: _number(o.mean("cpu_ms"), ".1f")})
    return table


def write_files(outcomes: Sequence[Outcome], folder: Path) -> None:
    """Write all but :data:`MARKER` into ``folder``, which exists."""
    from vioframe.report.plot_montecarlo import write_figures

    (folder / "nees.csv").write_text(to_csv(outcomes), encoding="utf-8")
    write_figures(outcomes, folder)


def to_csv(outcomes: Sequence[Outcome]) -> str:
    """Average NEES over time: a row an instant, with how many trials it is of."""
    lines = ["backend,flight,t_s,trials," + ",".join(f"{part},{part}_low,{part}_high" for part in PARTS)]
    for outcome in outcomes:
        found = [nees for part in PARTS if (nees := outcome.nees(part))]
        if not found:
            continue
        about = f'"{outcome.name}",{outcome.flight}'
        for k, (t_ns, trials) in enumerate(zip(found[0].t_ns.tolist(), found[0].trials.tolist(), strict=True)):
            values = ",".join(f"{n.values[k]:.6g},{n.low[k]:.6g},{n.high[k]:.6g}" for n in found)
            lines.append(f"{about},{t_ns / NS_PER_S:.9g},{trials},{values}")
    return "\n".join(lines) + "\n"


def _failures(outcome: Outcome) -> Text:
    from rich.text import Text

    by_kind = [f"{count} {kind}" for kind, count in outcome.failures.items() if count]
    total = sum(outcome.failures.values())
    return Text(f"{total} ({', '.join(by_kind)})", style="bold red") if total else Text("0")


def _error(outcome: Outcome, key: str, spec: str) -> str:
    rms, values = outcome.rms(key), outcome.values(key)
    return _UNKNOWN if rms is None else f"{rms:{spec}} ({values.max():{spec}})"


def _mean_nees(part: str) -> Callable[[Outcome], Text | str]:
    def show(nees: AverageNees) -> str:
        low, high = nees.mean_band
        return f"{nees.verdict}  {nees.mean:.2f} [{low:.2f}, {high:.2f}]"

    return _judged(part, show)


def _nees_per_axis(part: str) -> Callable[[Outcome], Text | str]:
    return _judged(part, lambda nees: f"{nees.per_axis:.2f} ({nees.inside:.0%})")


def _judged(part: str, show: Callable[[AverageNees], str]) -> Callable[[Outcome], Text | str]:
    from rich.text import Text

    def cell(outcome: Outcome) -> Text | str:
        nees = outcome.nees(part)
        return _UNKNOWN if nees is None else Text(show(nees), style=_COLOURS[nees.verdict])

    return cell


def _number(value: float | None, spec: str, factor: float = 1.0) -> str:
    return _UNKNOWN if value is None else format(factor * value, spec)
