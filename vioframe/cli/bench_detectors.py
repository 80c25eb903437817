"""``vioframe bench detectors``: how fast, how repeatable, and how well followed by the front-end."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.cli.common import FILE, Bar, PartName, print_notes, quiet_option, workers_option
from vioframe.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    import pandas as pd

    from vioframe.bench.detectors.entrants import LineUp

_SPEED_IMAGES, _SPEED_ROUNDS, _FLIGHT_S = 8, 10, 10.0
_USES = {
    "speed": ("dataset", "images", "limit", "rounds"),
    "quality": ("images", "hpatches", "limit", "degradation", "baseline", "workers"),
    "frontend": ("dataset", "degradation", "baseline", "start", "duration", "ground_truth", "workers"),
}
"""Of the arguments that not every question has a use for, those that each has."""

_Answer = tuple["pd.DataFrame", dict[str, Any], str]
"""What came out, the settings it was made with, and what its table is headed by."""


@click.command("detectors")
@click.argument("dataset", type=FILE, required=False)
@click.option("--quality", is_flag=True, help="Find places again, instead of speed.")
@click.option("--frontend", is_flag=True, help="Tracks of the front-end along DATASET, instead of speed.")
@click.option(
    "--detector",
    "detectors",
    metavar="NAME[:KEY=VALUE,...]",
    type=PartName("DETECTOR"),
    multiple=True,
    help="Detector.  [default: all]",
)
@click.option("-o", "--option", "options", metavar="NAME.KEY=VALUE", multiple=True, help="Set a detector's option.")
@click.option("--images", type=FILE, metavar="DIR", help="Photographs.")
@click.option("--hpatches", type=FILE, metavar="DIR", help="HPatches, for --quality.")
@click.option(
    "--limit",
    type=click.IntRange(1),
    metavar="N",
    help=f"Images, of each kind.  [default: {_SPEED_IMAGES} for speed, or all]",
)
@click.option("--degradation", metavar="NAME", multiple=True, help="Degrade by this alone.  [default: each]")
@click.option("--baseline", metavar="NAME[:...]", help="State leads over this detector.  [default: shi_tomasi]")
@click.option("--rounds", type=click.IntRange(1), metavar="N", help=f"Rounds to time.  [default: {_SPEED_ROUNDS}]")
@click.option("--start", type=click.FloatRange(0.0), metavar="S", help="Skip the first S seconds of DATASET.")
@click.option("--duration", type=float, metavar="S", help=f"Seconds of DATASET.  [default: {_FLIGHT_S:g}]")
@click.option("--ground-truth", type=FILE, help="True motion, where DATASET brings none: TUM or EuRoC csv.")
@workers_option
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of all that is random.")
@click.option("--record", "keep", type=FILE, metavar="FILE", help="Also write the results, as JSON.")
@quiet_option
def detectors(
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

    Speed is timed on drawn surfaces, on photographs (--images DIR) and on frames
    of DATASET alike: on some images some detectors have more to do than on others.

    \b
    --quality   the HPatches protocol at 320 x 240 with 300 keypoints, on
                photographs through homographies (--images DIR) or on HPatches
                itself (--hpatches DIR), as they are and degraded
    --frontend  how long and how truly the front-end follows what was detected
                along DATASET, as it is and degraded
    """
    if quality and frontend:
        raise ConfigError("--quality and --frontend are two questions; ask one at a time")
    question = "quality" if quality else "frontend" if frontend else "speed"
    given = _given(question, specific)
    import pandas as pd

    from vioframe.bench.detectors import tables
    from vioframe.bench.detectors.entrants import everyone, line_up, parse_entrants
    from vioframe.bench.results import record
    from vioframe.cores import usable_cores
    from vioframe.parts import registry

    installed = registry.load()
    entrants = parse_entrants(detectors or everyone(installed, question), options, installed, describing=quality)
    if (over := given.get("baseline")) is not None and over not in (labels := [each.called for each in entrants]):
        raise ConfigError(f"--baseline {over} does not take part; one of {', '.join(labels)} can be led over")
    given |= {"baseline": over or tables.BASELINE, "workers": given.get("workers") or usable_cores(), "seed": seed}
    given["quiet"] = quiet

    @cache
    def lined_up() -> LineUp:
        return line_up(entrants, installed)

    ask = {"speed": _speed, "quality": _quality, "frontend": _frontend}
    result, settings, heading = ask[question](given, lined_up)
    click.echo("\n\n".join(tables.shown(question, heading, result, given["baseline"])))
    absent = lined_up().absent
    print_notes(f"{label} does not take part: {reason}" for label, reason in absent.items())
    if keep is not None:
        rows: list[Any] = result.astype(object).where(pd.notna(result), None).to_dict("records")
        rows += [{"detector": label, "absent": reason} for label, reason in absent.items()]
        taking_part = {entrant.called: entrant.options for entrant, _ in lined_up().ready}
        record(keep, rows, {"question": question, "seed": seed, **settings, "detectors": taking_part})
        if not quiet:
            click.echo(f"written to {keep}")


def _given(question: str, specific: dict[str, Any]) -> dict[str, Any]:
    """The arguments that ``question`` has a use for; raises :class:`ConfigError` for one that would do nothing."""
    for name, value in specific.items():
        if value not in (None, ()) and name not in _USES[question]:
            use = " or ".join(f"--{other}" for other, uses in _USES.items() if name in uses and other != "speed")
            alone = "or is about speed" if use else "it is about speed alone"
            remedy = " ".join([f"it goes with {use}"] * bool(use) + [alone] * (name in _USES["speed"]))
            argument = "DATASET" if name == "dataset" else "--" + name.replace("_", "-")
            raise ConfigError(f"{argument} would do nothing here: {remedy}")
    return {name: specific[name] for name in _USES[question]}


def _speed(given: dict[str, Any], lined_up: Callable[[], LineUp]) -> _Answer:
    from vioframe.bench.detectors import speed
    from vioframe.parts import registry

    rounds = given["rounds"] or _SPEED_ROUNDS
    recording = None if given["dataset"] is None else registry.load().open_dataset(given["dataset"])
    each = given["limit"] or _SPEED_IMAGES
    pictures = speed.pictures(each, folder=given["images"], recording=recording, seed=given["seed"])
    ready = lined_up().ready
    with Bar(rounds + 1, "rounds", quiet=given["quiet"]) as bar:
        result = speed.time_detectors(ready, pictures, rounds, on_round=lambda count: bar(advance=count))
    settings = speed.speed_settings(rounds)
    heading = (
        f"Frames a second at 640 x 480, {speed.MAX_POINTS} keypoints, one at a time, decoding excluded: "
        f"{'; '.join(settings['devices'])}; {rounds} rounds; median and quartiles"
    )
    return result, settings, heading


def _quality(given: dict[str, Any], lined_up: Callable[[], LineUp]) -> _Answer:
    from vioframe.bench.detectors import quality
    from vioframe.bench.detectors.degradations import choose
    from vioframe.bench.detectors.images import evenly, hpatches_pairs, synthetic_pairs

    images, hpatches, over = given["images"], given["hpatches"], given["baseline"]
    if images is not None and hpatches is not None:
        raise ConfigError("--images and --hpatches are two sets of pairs; measure one at a time")
    degradations = choose(given["degradation"])
    if images is not None:
        pairs, source = synthetic_pairs(images, given["seed"]), f"{images.name}, synthetic homographies"
    elif hpatches is not None:
        pairs, source = hpatches_pairs(hpatches), "HPatches"
    else:
        raise DatasetError("no images given: --images DIR for any photographs, or --hpatches DIR")
    pairs = evenly(pairs, given["limit"])
    entrants = [entrant for entrant, _ in lined_up().ready]
    with Bar(len(pairs), "pairs", quiet=given["quiet"]) as bar:
        how = {"seed": given["seed"], "workers": given["workers"], "on_pairs": lambda count: bar(advance=count)}
        result = quality.summary(quality.score_detectors(entrants, pairs, degradations, **how), over)
    settings = {"pairs": source, "pair_count": len(pairs), "resolution": quality.RESOLUTION, "top_k": quality.TOP_K}
    heading = (
        f"Found again: {len(pairs)} pairs ({source}), 320 x 240, the {quality.TOP_K} strongest in both views, within "
        "3 px; mean and standard deviation over pairs"
    )
    return result, {**settings, "baseline": over}, heading


def _frontend(given: dict[str, Any], lined_up: Callable[[], LineUp]) -> _Answer:
    from vioframe.bench.detectors import flight
    from vioframe.bench.detectors.degradations import choose
    from vioframe.simulation.config import made_of
    from vioframe.simulation.seeds import purpose_of

    if given["dataset"] is None:
        raise DatasetError(
            "no recording given: `vioframe bench detectors --frontend DATASET`; `vioframe simulate` makes some"
        )
    degradations, over = choose(given["degradation"]), given["baseline"]
    duration_s = _FLIGHT_S if given["duration"] is None else given["duration"]
    stretch = flight.Stretch(given["dataset"], given["start"] or 0.0, duration_s, given["ground_truth"])
    name, made = flight.check(stretch), made_of(stretch.path)
    where = "" if made is None else f" (simulated, seed {made.seed}, for {purpose_of(made.seed) or 'nothing special'})"
    entrants = [entrant for entrant, _ in lined_up().ready]
    with Bar(len(degradations), "flights", quiet=given["quiet"]) as bar:
        how = {"seed": given["seed"], "workers": given["workers"], "on_flight": lambda count: bar(advance=count)}
        result = flight.fly_detectors(entrants, stretch, degradations, baseline=over, **how)
    settings = {
        "dataset": name,
        "simulated_seed": None if made is None else made.seed,
        "start_s": stretch.start_s,
        "duration_s": duration_s,
        "baseline": over,
        "epipolar_baseline_frames": flight.BASELINE_FRAMES,
        "epipolar_inlier_px": flight.INLIER_PX,
    }
    heading = (
        f"Followed by the front-end: {name}{where}, {duration_s:g} s after the first {stretch.start_s:g} s; inliers "
        f"within {flight.INLIER_PX:g} px of the true epipolar line over {flight.BASELINE_FRAMES} frames"
    )
    return result, settings, heading
