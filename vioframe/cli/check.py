"""``vioframe check``: what is wrong with a recording, ahead of a run; or with a plug-in, by the conformance kit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vioframe.cli import EXIT_FAILED
from vioframe.cli.common import FILE, Bar, PartName, calibration_option, cameras_option, print_table
from vioframe.cores import limited_threads
from vioframe.diagnosis import Certainty, Diagnosis, Finding, Severity, diagnose, gather
from vioframe.diagnosis.images import wrong_size
from vioframe.errors import ConfigError, DatasetError, ImageSizeError
from vioframe.interfaces import Dataset, Source
from vioframe.io.synchronise import played
from vioframe.live.tape import Tape
from vioframe.parts import registry
from vioframe.parts.options import did_you_mean
from vioframe.parts.registry import (
    BACKEND,
    DATASET,
    DETECTOR,
    FLIGHT,
    KINDS,
    LOOP_CLOSER,
    METRIC,
    SOURCE,
    Kind,
    Part,
    Registry,
)
from vioframe.types import FrameSet, Measurement

# A live source is listened to for so long, s.
_LISTENED_S = 20.0
_COLOURS = {Severity.WRONG: "bold red", Severity.WORTH_KNOWING: "yellow"}


@click.command("check")
@click.argument("target", metavar="DATA|NAME")
@calibration_option
@click.option("--reader", type=PartName("DATASET"), help="Data-set reader, where several accept DATA.")
@cameras_option("target", "look at", "all")
@click.option("--start", "start_s", type=float, default=0.0, metavar="S", help="Skip the first S seconds.")
@click.option("--duration", "duration_s", type=float, metavar="S", help="Stop after S seconds.")
@click.option("--data", type=FILE, help="For a reader: a recording to try it on.")
@click.option("--json", "as_json", is_flag=True, help="Print all that was found as JSON.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def check(target: str, as_json: bool, quiet: bool, data: Path | None, **choices: Any) -> None:
    """Say what is wrong with DATA, a recording or a live source, or whether the plug-in NAME keeps its promises.

    Of a recording stamps, readings and images are looked at, and points are followed where it moves most, to compare
    camera and IMU with each other and with the calibration. What is found is listed with the likeliest cause first,
    each with what to do about it. Of a live source, NAME:ADDRESS, the next 20 seconds are recorded and looked at
    (--duration for others): turn and move it about all axes. A plug-in is put through the conformance kit,
    `vioframe.testing`.

    The exit code is 1 where something is wrong.
    """
    installed = registry.load()
    quiet = quiet or as_json
    if not (Path(target).exists() or ":" in target):
        wrong = _check_parts(installed, target, data, as_json=as_json)
    elif installed.resolve(target, choices["reader"])[0].kind is SOURCE:
        wrong = _check_source(installed, target, as_json=as_json, quiet=quiet, **choices)
    else:
        wrong = _check_recording(installed, target, as_json=as_json, quiet=quiet, **choices)
    if wrong:
        click.get_current_context().exit(EXIT_FAILED)


def _check_source(
    installed: Registry,
    address: str,
    *,
    calibration: tuple[Path, ...],
    cameras: list[str] | None,
    start_s: float,
    duration_s: float | None,
    quiet: bool,
    **choices: Any,
) -> bool:
    """A recording of what comes in a while from now on is checked."""
    given = {"calibration": list(calibration) or None, "cameras": cameras}
    options = {name: value for name, value in given.items() if value}
    source = cast(Source, installed.open_dataset(address, options=options))
    duration_s = _LISTENED_S if duration_s is None else duration_s
    with TemporaryDirectory() as folder, installed.blaming():
        recording = Path(folder) / f"{source.name}.mcap"
        with Tape(recording, source.calibration) as tape, Bar(None, source.name, quiet=quiet) as bar:
            try:
                for measurement in _watched(source, 0.0, start_s + duration_s, bar):
                    tape.add(measurement)
            finally:
                source.close()
        # In the recording are the cameras that were chosen, by the names of their calibration.
        choices |= {"calibration": (), "cameras": None, "start_s": start_s, "duration_s": duration_s}
        return _check_recording(installed, str(recording), called=address, quiet=quiet, **choices)


def _check_recording(
    installed: Registry,
    target: str,
    *,
    called: str | None = None,
    as_json: bool,
    quiet: bool,
    calibration: tuple[Path, ...],
    reader: str | None,
    cameras: list[str] | None,
    start_s: float,
    duration_s: float | None,
) -> bool:
    part, _ = installed.resolve(target, reader)
    options: dict[str, Any] = {"calibration": list(calibration)} if calibration else {}
    looked: dict[str, Diagnosis] = {}
    aside: list[str] = []
    try:
        dataset = installed.open_dataset(target, part.name, options)
        rig = [camera.name for camera in dataset.calibration.cameras]
        for chosen in cameras or rig:
            if cameras or (len(rig) > 1 and any(option.name == "cameras" for option in part.options)):
                dataset = installed.open_dataset(target, part.name, {**options, "cameras": [chosen]})
            with Bar(dataset.frame_count, quiet=quiet, late=True) as bar, limited_threads(), installed.blaming():
                found = diagnose(gather(_watched(dataset, start_s, duration_s, bar), dataset.calibration))
            looked[dataset.calibration.cameras[0].name] = _without_what_was_said(found, looked.values())
        aside = [name for name in rig if name not in looked]
    except ImageSizeError as error:
        # Some readers look at an image as they open a recording.
        looked[", ".join(cameras or ())] = Diagnosis((wrong_size(error),), {})
    wrong = any(found.wrong for found in looked.values())
    if as_json:
        findings = [{"camera": name, **asdict(each)} for name, found in looked.items() for each in found.findings]
        facts = {name: found.facts for name, found in looked.items()}
        tree = {"data": called or target, "reader": part.name, "wrong": wrong, "facts": facts}
        click.echo(json.dumps({**tree, "cameras_left_aside": aside, "findings": findings}, indent=2))
    else:
        for found in looked.values():
            _show(called or f"{target} (reader {part.name})", found, aside)
    return wrong


def _without_what_was_said(found: Diagnosis, before: Iterable[Diagnosis]) -> Diagnosis:
    """What is wrong with the IMU is found again with each camera, and said once."""
    said = [finding for other in before for finding in other.findings]
    return replace(found, findings=tuple(finding for finding in found.findings if finding not in said))


def _watched(dataset: Dataset, start_s: float, duration_s: float | None, bar: Bar) -> Iterator[Measurement]:
    for measurement in played(dataset.measurements(), start_s, duration_s):
        if isinstance(measurement, FrameSet):
            bar("read")
        yield measurement


def _show(called: str, found: Diagnosis, aside: list[str]) -> None:
    """What was looked at in a line each, then the findings, the cause first."""
    console = Console()
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim")
    facts.add_column(overflow="fold")
    for name, fact in found.facts.items():
        facts.add_row(name, Text(fact))
    if aside:
        facts.add_row("left aside", Text(f"{', '.join(aside)}; look at them with --cameras {','.join(aside)}"))
    console.print(Text(called, style="bold"))
    console.print(facts) if console.is_terminal else print_table(facts)
    if not found.findings:
        console.print(Text("Nothing wrong was found.", style="green"))
        return
    listed = Table.grid(padding=(0, 2))
    listed.add_column()
    listed.add_column(overflow="fold")
    for finding in found.findings:
        listed.add_row(Text(finding.severity, style=_COLOURS[finding.severity]), _told(finding))
    console.print()
    console.print(listed) if console.is_terminal else print_table(listed)
    if not found.wrong:
        console.print(Text("\nNothing wrong was found.", style="green"))


def _told(finding: Finding) -> Text:
    sure = "" if finding.certainty is Certainty.CERTAIN else f", {finding.certainty}"
    return Text.assemble(
        (finding.sentence[:1].upper() + finding.sentence[1:] + ".", ""),
        (f"  [{finding.kind}{sure}]\n", "dim"),
        ("-> " + finding.remedy, "cyan"),
    )


def _check_parts(installed: Registry, name: str, data: Path | None, *, as_json: bool) -> bool:
    """Put every part called ``name`` through the conformance kit; whether one fails it."""
    parts = [table[name] for kind in KINDS if name in (table := installed.parts.get(kind.name, {}))]
    if not parts:
        known = sorted({part for kind in KINDS for part in installed.names(kind)})
        raise DatasetError(
            f"{name} is no recording here and no part is called so{did_you_mean(name, known)}; "
            "`vioframe plugins` lists the parts"
        )
    results = [(part, _complaint(part, data)) for part in parts]
    if as_json:
        tree = [{"kind": part.kind.name, "name": part.name, "complaint": why} for part, why in results]
        click.echo(json.dumps({"wrong": any(why for _, why in results), "parts": tree}, indent=2))
    else:
        for part, why in results:
            click.echo(f"{part}: {why or 'keeps to all that is promised'}")
    return any(why for _, why in results)


def _complaint(part: Part, data: Path | None) -> str:
    """What the kit says of ``part``; "" where it conforms."""
    from vioframe import testing

    checks: dict[Kind, Callable[[Any], None]] = {
        DETECTOR: testing.check_detector,
        BACKEND: testing.check_backend,
        LOOP_CLOSER: testing.check_loop_closer,
        FLIGHT: testing.check_flight,
        METRIC: testing.check_metric,
    }
    try:
        with limited_threads():
            if part.kind is DATASET:
                if data is None:
                    raise ConfigError(f"name a recording to try {part} on, with --data")
                testing.check_dataset(part.factory, data)
            elif part.kind is SOURCE:
                if data is None:
                    raise ConfigError(f"name what to try {part} on, what stands behind {part.name}:, with --data")
                testing.check_source(part.factory, str(data))
            elif part.kind in checks:
                checks[part.kind](part.factory)
            else:
                raise ConfigError(f"there is no conformance kit for a {part.kind.name}")
    except AssertionError as error:
        return " ".join(str(error).split())
    return ""
