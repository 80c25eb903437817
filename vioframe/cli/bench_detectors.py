"""``vioframe bench detectors``: how fast, how repeatable, and how well followed by the front-end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.errors import ConfigError, DatasetError, PluginError

if TYPE_CHECKING:
    import pandas as pd

    from vioframe.bench.detectors.entrants import Entrant, LineUp
    from vioframe.parts.registry import Registry

_FILE = click.Path(path_type=Path)
_SPEED_IMAGES, _SPEED_ROUNDS, _FLIGHT_S = 8, 10, 10.0
_USES = {
    "speed": ("images", "limit", "rounds"),
    "quality": ("images", "hpatches", "limit", "degradation", "baseline", "workers"),
    "frontend": ("dataset", "degradation", "baseline", "start", "duration", "ground_truth", "workers"),
}
"""Of the arguments that not every question has a use for, those that each has."""


@dataclass(frozen=True)
class _Request:
    entrants: Sequence[Entrant]
    installed: Registry
    seed: int
    quiet: bool
    given: dict[str, Any]
    """Arguments of the one question by name."""

    def __getitem__(self, name: str) -> Any:
        return self.given[name]

    @property
    def workers(self) -> int:
        from vioframe.bench.processes import usable_cores

        return self["workers"] or usable_cores()

    def line_up(self, *, describing: bool = False) -> LineUp:
        """Those that can take part; asked for descriptors where these are of use."""
        from vioframe.bench.detectors.entrants import line_up

        entrants = [each.describing(self.installed) for each in self.entrants] if describing else self.entrants
        return line_up(entrants, self.installed)

    def baseline(self) -> str:
        """The detector to lead over; raises :class:`ConfigError` where the one asked for does not take part."""
        from vioframe.bench.detectors.tables import BASELINE

        given, labels = self["baseline"], [entrant.label for entrant in self.entrants]
        if given is not None and given not in labels:
            raise ConfigError(f"--baseline {given} does not take part; one of {', '.join(labels)} can be led over")
        return given or BASELINE

    @contextmanager
    def watch(self, what: str, total: int) -> Iterator[Callable[[int], None]]:
        """A progress bar, to be told how many more are done."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (BarColumn(bar_width=12), MofNCompleteColumn(), TextColumn(what), TimeRemainingColumn(compact=True))
        with Progress(*columns, console=Console(stderr=True), disable=self.quiet) as progress:
            task = progress.add_task("", total=total)
            yield lambda count: progress.advance(task, count)


@dataclass(frozen=True)
class _Answer:
    result: pd.DataFrame
    settings: dict[str, Any]
    tables: Sequence[str]
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
@click.option("--degradation", metavar="NAME", multiple=True, help="Degrade by this alone.  [default: each]")
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
    """Compare detectors: by default their speed at 640 x 480 with 300 keypoints.

    \b
    --quality   the HPatches protocol at 320 x 240 with 300 keypoints, on
                photographs through homographies (--images DIR) or on HPatches
                itself (--hpatches DIR), as they are and degraded
    --frontend  how long and how truly the front-end follows what was detected
                along DATASET, as it is and degraded

    docs/bench_detectors.md says what the figures mean.
    """
    if quality and frontend:
        raise ConfigError("--quality and --frontend are two questions; ask one at a time")
    question = "quality" if quality else "frontend" if frontend else "speed"
    given = _given(question, specific)
    try:
        import pandas as pd

        from vioframe.bench.detectors.entrants import everyone, parse_entrants
    except ModuleNotFoundError as error:
        if error.name != "pandas":
            raise
        raise PluginError("comparing detectors needs pandas: pip install 'vioframe[bench]'") from error
    from vioframe.bench.results import record
    from vioframe.parts import registry

    installed = registry.load()
    entrants = parse_entrants(detectors or everyone(installed, question), options, installed)
    ask = {"speed": _speed, "quality": _quality, "frontend": _frontend}
    answer = ask[question](_Request(entrants, installed, seed, quiet, given))
    click.echo("\n\n".join(answer.tables))
    absent = answer.line_up.absent
    for label, reason in absent.items():
        click.echo(f"note: {label} does not take part: {reason}", err=True)
    if keep is not None:
        known = answer.result.astype(object).where(pd.notna(answer.result), None)
        rows: list[Any] = [
            *known.to_dict("records"),
            *({"detector": label, "absent": reason} for label, reason in absent.items()),
        ]
        taking_part = {entrant.label: dict(entrant.options) for entrant, _ in answer.line_up.ready}
        record(keep, rows, {"question": question, "seed": seed, **answer.settings, "detectors": taking_part})
        click.echo(f"written to {keep}")


def _given(question: str, specific: dict[str, Any]) -> dict[str, Any]:
    """The arguments that ``question`` has a use for; raises :class:`ConfigError` for one that would do nothing."""
    for name, value in specific.items():
        if value not in (None, ()) and name not in _USES[question]:
            use = " or ".join(f"--{other}" for other, uses in _USES.items() if name in uses and other != "speed")
            remedy = f"it goes with {use}" if use else "it is about speed alone"
            argument = "DATASET" if name == "dataset" else "--" + name.replace("_", "-")
            raise ConfigError(f"{argument} would do nothing here: {remedy}")
    return {name: specific[name] for name in _USES[question]}


def _speed(asked: _Request) -> _Answer:
    import pandas as pd

    from vioframe.bench.detectors import speed, tables
    from vioframe.bench.detectors.images import evenly, find_images, fit, procedural_images, read_grey

    images, limit, rounds = asked["images"], asked["limit"] or _SPEED_IMAGES, asked["rounds"] or _SPEED_ROUNDS
    if images is None:
        pictures, source = procedural_images(limit, speed.RESOLUTION, asked.seed), "drawn surfaces"
    else:
        pictures = [fit(read_grey(path), speed.RESOLUTION) for path in evenly(find_images(images), limit)]
        source = images.name
    lined_up = asked.line_up()
    with asked.watch("rounds", rounds + 1) as on_done:
        result = pd.DataFrame(speed.time_detectors(lined_up.ready, pictures, rounds, on_round=on_done))
    settings = speed.speed_settings(source, len(pictures), rounds)
    heading = (
        f"Frames a second at 640 x 480, {speed.MAX_POINTS} keypoints, one at a time, decoding excluded: "
        f"{'; '.join(settings['devices'])}; {len(pictures)} images ({source}) in {rounds} rounds; median and quartiles"
    )
    return _Answer(result, settings, [f"{heading}\n{tables.overview(result, tables.SPEED)}"], lined_up)


def _quality(asked: _Request) -> _Answer:
    from vioframe.bench.detectors import quality, tables
    from vioframe.bench.detectors.degradations import choose
    from vioframe.bench.detectors.images import evenly, hpatches_pairs, synthetic_pairs

    images, hpatches = asked["images"], asked["hpatches"]
    if images is not None and hpatches is not None:
        raise ConfigError("--images and --hpatches are two sets of pairs; measure one at a time")
    chosen, over = choose(asked["degradation"]), asked.baseline()
    if images is not None:
        pairs, source = synthetic_pairs(images, asked.seed), f"{images.name}, synthetic homographies"
    elif hpatches is not None:
        pairs, source = hpatches_pairs(hpatches), "HPatches"
    else:
        raise DatasetError("no images given: --images DIR for any photographs, or --hpatches DIR")
    pairs = evenly(pairs, asked["limit"])
    lined_up = asked.line_up(describing=True)
    entrants = [entrant for entrant, _ in lined_up.ready]
    with asked.watch("pairs", len(pairs)) as on_done:
        scores = quality.score_detectors(
            entrants, pairs, chosen, seed=asked.seed, workers=asked.workers, on_pairs=on_done
        )
    settings = {"pairs": source, "pair_count": len(pairs), "resolution": quality.RESOLUTION, "top_k": quality.TOP_K}
    heading = (
        f"Found again: {len(pairs)} pairs ({source}), 320 x 240, the {quality.TOP_K} strongest in both views, within "
        "3 px; mean and standard deviation over pairs"
    )
    result = quality.summary(scores, over)
    return _Answer(result, {**settings, "baseline": over}, tables.swept("quality", heading, result, over), lined_up)


def _frontend(asked: _Request) -> _Answer:
    from vioframe.bench.detectors import flight, tables
    from vioframe.bench.detectors.degradations import choose

    if asked["dataset"] is None:
        raise DatasetError(
            "no recording given: `vioframe bench detectors --frontend DATASET`; `vioframe simulate` makes some"
        )
    chosen, over = choose(asked["degradation"]), asked.baseline()
    duration_s = _FLIGHT_S if asked["duration"] is None else asked["duration"]
    stretch = flight.Stretch(asked["dataset"], asked["start"] or 0.0, duration_s, asked["ground_truth"])
    name = flight.check(stretch, asked.installed)
    lined_up = asked.line_up()
    entrants = [entrant for entrant, _ in lined_up.ready]
    with asked.watch("flights", len(chosen)) as on_done:
        result = flight.fly_detectors(
            entrants, stretch, chosen, seed=asked.seed, workers=asked.workers, baseline=over, on_flight=on_done
        )
    settings = {
        "dataset": name,
        "start_s": stretch.start_s,
        "duration_s": stretch.duration_s,
        "baseline": over,
        "epipolar_baseline_frames": flight.BASELINE_FRAMES,
        "epipolar_inlier_px": flight.INLIER_PX,
    }
    heading = (
        f"Followed by the front-end: {name}, {stretch.duration_s:g} s after the first {stretch.start_s:g} s; inliers "
        f"within {flight.INLIER_PX:g} px of the true epipolar line over {flight.BASELINE_FRAMES} frames"
    )
    return _Answer(result, settings, tables.swept("frontend", heading, result, over), lined_up)
