"""``vioframe bench detectors``: how fast, how repeatable, and how well followed by the front-end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from rich.console import Group

    from vioframe.bench.detectors.entrants import Entrant, LineUp
    from vioframe.bench.results import Row
    from vioframe.parts.registry import Registry

_FILE = click.Path(path_type=Path)
_WIDE = 1000
_SPEED_IMAGES, _SPEED_ROUNDS, _FLIGHT_S = 8, 10, 10.0

_USES = {
    "speed": ("images", "limit", "rounds"),
    "quality": ("images", "hpatches", "limit", "degradations", "baseline", "workers"),
    "frontend": ("dataset", "degradations", "baseline", "start", "duration", "ground_truth", "workers"),
}
"""Of the arguments that not every question has a use for, those that each has."""
_ARGUMENTS = {"dataset": "DATASET", "degradations": "--degradation"}


@dataclass(frozen=True)
class _Request:
    entrants: Sequence[Entrant]
    installed: Registry
    seed: int
    quiet: bool


@dataclass(frozen=True)
class _Answer:
    rows: Sequence[Row]
    settings: dict[str, Any]
    tables: Sequence[Group]
    line_up: LineUp


@click.command("detectors")
@click.argument("dataset", type=_FILE, required=False)
@click.option("--quality", is_flag=True, help="Find places again, instead of speed.")
@click.option("--frontend", is_flag=True, help="Tracks of the front-end along DATASET, instead of speed.")
@click.option(
    "--detector", "detectors", metavar="NAME[:KEY=VALUE,...]", multiple=True, help="Detector.  [default: all]"
)
@click.option("-o", "--option", "options", metavar="NAME.KEY=VALUE", multiple=True, help="Set a detector's option.")
@click.option("--images", type=_FILE, metavar="DIR", help="Photographs.  [default for speed: drawn surfaces]")
@click.option("--hpatches", type=_FILE, metavar="DIR", help="HPatches, for --quality.")
@click.option(
    "--limit", type=click.IntRange(1), metavar="N", help=f"Images.  [default: {_SPEED_IMAGES} for speed, or all]"
)
@click.option(
    "--degradation", "degradations", metavar="NAME", multiple=True, help="Degrade by this alone.  [default: each]"
)
@click.option("--baseline", metavar="NAME[:...]", help="State leads over this detector.  [default: shi_tomasi]")
@click.option("--rounds", type=click.IntRange(1), metavar="N", help=f"Rounds to time.  [default: {_SPEED_ROUNDS}]")
@click.option("--start", type=click.FloatRange(0.0), metavar="S", help="Skip the first S seconds of DATASET.")
@click.option("--duration", type=float, metavar="S", help=f"Seconds of DATASET.  [default: {_FLIGHT_S:g}]")
@click.option("--ground-truth", type=_FILE, help="True motion, where DATASET brings none: TUM or EuRoC csv.")
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes.  [default: one a core]")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of all that is random.")
@click.option("--record", "keep", type=_FILE, metavar="FILE", help="Also write the results, as JSON.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def command(
    quality: bool,
    frontend: bool,
    detectors: tuple[str, ...],
    options: tuple[str, ...],
    seed: int,
    keep: Path | None,
    quiet: bool,
    **specific: Any,
) -> None:
    """Compare detectors: by default their speed at 640 x 480 with 300 keypoints, as in the thesis' Table 3.2.

    \b
    --quality   the HPatches protocol at 320 x 240 with 300 keypoints, on
                photographs through homographies (--images DIR) or on HPatches
                itself (--hpatches DIR), as they are and degraded
    --frontend  how long and how truly the front-end follows what was detected
                along DATASET, as it is and degraded

    docs/bench_detectors.md says what the figures mean.
    """
    from vioframe.bench.detectors.entrants import everyone, parse_entrants
    from vioframe.bench.results import record
    from vioframe.parts import registry

    if quality and frontend:
        raise ConfigError("--quality and --frontend are two questions; ask one at a time")
    question = "quality" if quality else "frontend" if frontend else "speed"
    given = _given(question, specific)
    installed = registry.load()
    specs = detectors or everyone(installed, question)
    request = _Request(parse_entrants(specs, options, installed), installed, seed, quiet)
    questions: dict[str, Callable[..., _Answer]] = {"speed": _speed, "quality": _quality, "frontend": _frontend}
    answer = questions[question](request, **given)
    for table in answer.tables:
        _print(table)
    absent = answer.line_up.absent
    for label, reason in absent.items():
        click.echo(f"note: {label} does not take part: {reason}", err=True)
    if keep is not None:
        rows = [*answer.rows, *({"detector": label, "absent": reason} for label, reason in absent.items())]
        taking_part = {entrant.label: dict(entrant.options) for entrant, _ in answer.line_up.ready}
        record(keep, rows, {"question": question, "seed": seed, **answer.settings, "detectors": taking_part})
        click.echo(f"written to {keep}")


def _given(question: str, specific: dict[str, Any]) -> dict[str, Any]:
    """The arguments that ``question`` has a use for; raises :class:`ConfigError` for one that would do nothing."""
    for name, value in specific.items():
        if value not in (None, ()) and name not in _USES[question]:
            use = " or ".join(f"--{other}" for other, uses in _USES.items() if name in uses and other != "speed")
            remedy = f"it goes with {use}" if use else "it is about speed alone"
            argument = _ARGUMENTS.get(name, "--" + name.replace("_", "-"))
            raise ConfigError(f"{argument} would do nothing here: {remedy}")
    return {name: specific[name] for name in _USES[question]}


def _speed(request: _Request, images: Path | None, limit: int | None, rounds: int | None) -> _Answer:
    from vioframe.bench.detectors import speed, tables
    from vioframe.bench.detectors.entrants import line_up
    from vioframe.bench.detectors.images import evenly, find_images, fit, procedural_images, read_grey

    limit, rounds = limit or _SPEED_IMAGES, rounds or _SPEED_ROUNDS
    if images is None:
        pictures, source = procedural_images(limit, speed.RESOLUTION, request.seed), "drawn surfaces"
    else:
        pictures = [fit(read_grey(path), speed.RESOLUTION) for path in evenly(find_images(images), limit)]
        source = images.name
    lined_up = line_up(request.entrants, request.installed)
    with _watch("rounds", rounds + 1, request.quiet) as on_done:
        rows = speed.time_detectors(lined_up.ready, pictures, rounds, on_round=on_done)
    settings = speed.speed_settings(source, len(pictures), rounds)
    return _Answer(rows, settings, [tables.speed_table(rows, lined_up.absent, settings)], lined_up)


def _quality(
    request: _Request,
    images: Path | None,
    hpatches: Path | None,
    limit: int | None,
    degradations: tuple[str, ...],
    baseline: str | None,
    workers: int | None,
) -> _Answer:
    from vioframe.bench.detectors import quality, tables
    from vioframe.bench.detectors.degradations import choose
    from vioframe.bench.detectors.entrants import line_up
    from vioframe.bench.detectors.images import evenly
    from vioframe.bench.detectors.pairs import hpatches_pairs, synthetic_pairs
    from vioframe.bench.processes import usable_cores

    if images is not None and hpatches is not None:
        raise ConfigError("--images and --hpatches are two sets of pairs; measure one at a time")
    chosen, over = choose(degradations), _baseline(request, baseline)
    if images is not None:
        pairs, source = synthetic_pairs(images, request.seed), f"{images.name}, synthetic homographies"
    elif hpatches is not None:
        pairs, source = hpatches_pairs(hpatches), "HPatches"
    else:
        raise DatasetError("no images given: --images DIR for any photographs, or --hpatches DIR")
    pairs = evenly(pairs, limit)
    lined_up = line_up([entrant.describing(request.installed) for entrant in request.entrants], request.installed)
    entrants = [entrant for entrant, _ in lined_up.ready]
    with _watch("pairs", len(pairs), request.quiet) as on_done:
        scores = quality.score_detectors(
            entrants, pairs, chosen, seed=request.seed, workers=workers or usable_cores(), on_pairs=on_done
        )
    rows = quality.quality_rows(scores, over)
    settings = {
        "pairs": source,
        "pair_count": len(pairs),
        "resolution": quality.RESOLUTION,
        "top_k": quality.TOP_K,
        "baseline": over,
    }
    shown = [tables.quality_table(rows, settings), *tables.sweep_tables(rows, chosen, "quality", over)]
    return _Answer(rows, settings, shown, lined_up)


def _frontend(
    request: _Request,
    dataset: Path | None,
    degradations: tuple[str, ...],
    baseline: str | None,
    start: float | None,
    duration: float | None,
    ground_truth: Path | None,
    workers: int | None,
) -> _Answer:
    from vioframe.bench.detectors import flight, tables
    from vioframe.bench.detectors.degradations import choose
    from vioframe.bench.detectors.entrants import line_up
    from vioframe.bench.processes import usable_cores

    if dataset is None:
        raise DatasetError(
            "no recording given: `vioframe bench detectors --frontend DATASET`; `vioframe simulate` makes some"
        )
    chosen, over = choose(degradations), _baseline(request, baseline)
    stretch = flight.Stretch(dataset, start or 0.0, _FLIGHT_S if duration is None else duration, ground_truth)
    name = flight.check(stretch, request.installed)
    lined_up = line_up(request.entrants, request.installed)
    entrants = [entrant for entrant, _ in lined_up.ready]
    with _watch("flights", len(chosen), request.quiet) as on_done:
        rows = flight.fly_detectors(
            entrants,
            stretch,
            chosen,
            seed=request.seed,
            workers=workers or usable_cores(),
            baseline=over,
            on_flight=on_done,
        )
    settings = {
        "dataset": name,
        "start_s": stretch.start_s,
        "duration_s": stretch.duration_s,
        "baseline": over,
        "epipolar_baseline_frames": flight.BASELINE_FRAMES,
        "epipolar_inlier_px": flight.INLIER_PX,
    }
    shown = [tables.frontend_table(rows, settings), *tables.sweep_tables(rows, chosen, "frontend", over)]
    return _Answer(rows, settings, shown, lined_up)


def _baseline(request: _Request, given: str | None) -> str:
    """The detector to lead over; raises :class:`ConfigError` where the one asked for does not take part."""
    from vioframe.bench.detectors.leads import BASELINE

    labels = [entrant.label for entrant in request.entrants]
    if given is not None and given not in labels:
        raise ConfigError(f"--baseline {given} does not take part; one of {', '.join(labels)} can be led over")
    return given or BASELINE


@contextmanager
def _watch(what: str, total: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A progress bar, to be told how many more are done."""
    if quiet:
        yield lambda count: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(bar_width=12), MofNCompleteColumn(), TextColumn(what), TimeRemainingColumn(compact=True))
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=total)
        yield lambda count: progress.advance(task, count)


def _print(table: Group) -> None:
    from rich.console import Console

    console = Console()
    # Into a file or a pipe the table goes whole: rich would fold it at 80 columns.
    (console if console.is_terminal else Console(width=_WIDE)).print(table)
