"""``vioframe simulate``: a recording of a flight that never took place, with exact truth."""

from __future__ import annotations

import os
from pathlib import Path
from time import perf_counter
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from vioframe.errors import ConfigError, DatasetError
from vioframe.parts import registry
from vioframe.parts.config import validate
from vioframe.parts.options import did_you_mean, summary_of
from vioframe.simulation import config as configuration
from vioframe.simulation.conditions import CONDITIONS, Conditions
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.record import check_destinations, record
from vioframe.simulation.recording import DEFAULT_DURATION_S, SimulatedRecording
from vioframe.types import Frame

_FILE = click.Path(path_type=Path)


@click.command("simulate")
@click.argument("destinations", metavar="DST...", type=_FILE, nargs=-1)
@click.option("--list", "only_list", is_flag=True, help="List flights, worlds and conditions.")
@click.option("--flight", metavar="NAME|FILE", help="Flight by name, or a trajectory file (TUM, EuRoC) to fly along.")
@click.option("--imu", type=_FILE, metavar="SEQ", help="EuRoC sequence, or its imu0/data.csv: its real IMU, motion.")
@click.option("--world", metavar="NAME", help="World to fly through.  [default: hall]")
@click.option("-c", "--condition", "conditions", metavar="NAME=LEVEL", multiple=True, help="Hard condition, 0 to 1.")
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Option of flight, world or IMU.")
@click.option("--start", type=float, metavar="S", help="Skip the first S seconds of a file or sequence.")
@click.option("--duration", type=float, metavar="S", help=f"Length.  [default: {DEFAULT_DURATION_S:g} s; files: whole]")
@click.option("--seed", type=int, help="Seed of all that is random.  [default: 0]")
@click.option("--rate", type=float, metavar="HZ", help="Frames per second.  [default: 20]")
@click.option("--imu-rate", type=float, metavar="HZ", help="Rate of the IMU.  [default: the calibration's]")
@click.option("--exact-imu", is_flag=True, help="An IMU without noise and biases.")
@click.option("--calibration", type=_FILE, multiple=True, help="Calibration file or folder.  [default: EuRoC's]")
@click.option("--config", "config_file", type=_FILE, help="Configuration, or manifest of a recording to make again.")
@click.option("--compression", type=click.Choice(["bz2", "lz4", "zstd"]), help="Compress bags.  [default: no]")
@click.option("--workers", type=click.IntRange(1), help="Processes that render.  [default: the number of cores]")
@click.option("--overwrite", is_flag=True, help="Replace a simulated recording of the same name.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def command(
    destinations: tuple[Path, ...],
    only_list: bool,
    compression: str | None,
    workers: int | None,
    overwrite: bool,
    quiet: bool,
    **arguments: Any,
) -> None:
    """Render a flight through a world and write it as a recording, with images, IMU and exact ground truth.

    \b
    DST tells the format:  NAME.bag    ROS 1 bag
                           NAME.ros2   ROS 2 bag (a folder)
                           NAME.mcap   MCAP file
                           NAME        ASL folder, as EuRoC's

    Several DST are written in one go. Beside a bag go its calibration (DST.calib) and how it was made
    (DST.simulation: manifest, world mesh, ground truth); an ASL folder holds both.
    """
    installed = registry.load()
    if only_list:
        _list(installed)
        return
    if not destinations:
        raise DatasetError("no destination given: `vioframe simulate flight.bag`; --list shows what there is")
    check_destinations(destinations, compression, overwrite=overwrite)
    config = configuration.complete(_configure(installed, **arguments), installed)
    begin_s = perf_counter()
    recording = SimulatedRecording(config, installed, workers or os.cpu_count() or 1)
    with _Watch(recording, quiet) as watch:
        record(recording, destinations, compression=compression, overwrite=overwrite, on_frame=watch)
    if not quiet:
        _report(recording, destinations, perf_counter() - begin_s)


def _configure(
    installed: registry.Registry,
    *,
    config_file: Path | None,
    flight: str | None,
    imu: Path | None,
    world: str | None,
    conditions: tuple[str, ...],
    options: tuple[str, ...],
    calibration: tuple[Path, ...],
    exact_imu: bool,
    **numbers: Any,
) -> SimulationConfig:
    """The configuration file, if any, with the command line's choices over it."""
    config = SimulationConfig() if config_file is None else configuration.read(config_file)
    tree = config.model_dump() | {"made": {}}
    if flight is not None:
        motion = _flight_or_file(installed, flight)
        tree |= {"flight": SimulationConfig().flight.model_dump(), "trajectory": None, "recorded": None} | motion
    if imu is not None:
        tree |= {"recorded": imu}
    if world is not None and world != tree["world"]["name"]:
        tree["world"] = {"name": world}
    tree["conditions"] |= Conditions.parse(conditions).levels
    if calibration:
        tree["calibration"] = calibration
    tree["exact_imu"] |= exact_imu
    keys = {"start": "start_s", "duration": "duration_s", "rate": "frame_rate_hz", "imu_rate": "imu_rate_hz"}
    tree |= {keys.get(name, name): value for name, value in numbers.items() if value is not None}
    return configuration.override(validate(SimulationConfig, tree, "command line"), installed, options)


def _flight_or_file(installed: registry.Registry, flight: str) -> dict[str, Any]:
    """A name that is installed is a flight; anything else that exists, or looks like a path, is a file."""
    names = installed.names(registry.FLIGHT)
    if flight in names:
        return {"flight": {"name": flight}}
    if Path(flight).exists() or Path(flight).suffix or os.sep in flight:
        return {"trajectory": Path(flight)}
    raise ConfigError(
        f"no flight is called {flight!r}{did_you_mean(flight, names)}; "
        f"installed: {', '.join(names)}; or name a trajectory file"
    )


class _Watch:
    """A progress bar that moves with each frame written, unless ``quiet``."""

    def __init__(self, recording: SimulatedRecording, quiet: bool) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
        )
        console = Console(stderr=True)
        self._progress = Progress(*columns, TimeRemainingColumn(compact=True), console=console, disable=quiet)
        self._task = self._progress.add_task(recording.name, total=recording.frame_count, rate="")

    def __enter__(self) -> _Watch:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, frame: Frame) -> None:
        task = self._progress.tasks[self._task]
        rate = (task.completed + 1) / max(task.elapsed or 0.0, 1e-3)
        self._progress.update(self._task, advance=1, rate=f"{rate:.1f} frames/s")


def _report(recording: SimulatedRecording, destinations: tuple[Path, ...], wall_s: float) -> None:
    truth = recording.ground_truth
    click.echo(
        f"{recording.name}: {recording.frame_count} frames and {recording.imu_count} IMU samples of "
        f"{truth.duration_s:.1f} s along {truth.path_length_m:.1f} m, in {wall_s:.0f} s"
    )
    if levels := recording.conditions.levels:
        click.echo("conditions: " + ", ".join(f"{name} {level:g}" for name, level in levels.items()))
    click.echo(f"written to {', '.join(map(str, destinations))}; next:\n  vioframe run {destinations[0]}")


def _list(installed: registry.Registry) -> None:
    console = Console()
    for kind in (registry.FLIGHT, registry.WORLD):
        rows = {name: summary_of(installed.find(kind, name).factory) for name in installed.names(kind)}
        console.print(_table(f"{kind.name}s", rows))
    console.print(_table("conditions (level 0 to 1)", CONDITIONS))
    console.print("Options of a flight or world: `vioframe plugins NAME`.")


def _table(title: str, rows: dict[str, str]) -> Table:
    table = Table(title=title, title_style="bold", title_justify="left", box=None, pad_edge=False, show_header=False)
    for name, text in rows.items():
        table.add_row(Text(name, style="cyan"), Text(text))
    return table
