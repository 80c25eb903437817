"""``vioframe simulate`` writes a recording of a flight that never took place, ``convert`` one in another format."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import click
from click.shell_completion import CompletionItem

from vioframe.cli.common import FILE, Bar, PartName, calibration_option, cameras_option, print_notes, quiet_option
from vioframe.cores import usable_cores
from vioframe.errors import DatasetError
from vioframe.io.convert import FORMATS, format_of
from vioframe.io.convert import convert as write_converted
from vioframe.parts import registry
from vioframe.parts.config import parse_assignments, validate
from vioframe.parts.options import summary_of
from vioframe.simulation import config as configuration
from vioframe.simulation.conditions import CONDITIONS, OF_THE_FLIGHT, parse_levels
from vioframe.simulation.config import RIGS, SimulationConfig
from vioframe.simulation.record import check_destinations, record
from vioframe.simulation.recording import DEFAULT_DURATION_S, SimulatedRecording
from vioframe.types import FrameSet, Measurement

_COMPRESSIONS = sorted({name for format in FORMATS.values() for name in format.compressions})


def _complete_rig(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    named = [CompletionItem(name) for name in RIGS if name.startswith(incomplete)]
    return named or [CompletionItem(incomplete, type="file")]


@click.command("simulate")
@click.argument("destinations", metavar="DST...", type=FILE, nargs=-1)
@click.option("--list", "only_list", is_flag=True, help="List flights, worlds, rigs and conditions.")
@click.option(
    "--flight",
    metavar="NAME|FILE",
    type=PartName("FLIGHT"),
    help="Flight by name, or a trajectory file (TUM, EuRoC) to fly along.",
)
@click.option(
    "--imu", "recorded", type=FILE, metavar="SEQ", help="EuRoC sequence, or its imu0/data.csv: its real IMU, motion."
)
@click.option("--world", type=PartName("WORLD"), help="World to fly through.  [default: hall]")
@click.option(
    *("-c", "--condition", "conditions"),
    metavar="[CAMERA.]NAME=LEVEL",
    multiple=True,
    help="Hard condition, 0 to 1, for all cameras or for one.",
)
@click.option(
    *("-o", "--option", "options"),
    metavar="KEY=VALUE",
    multiple=True,
    help="Option of flight, world or IMU; `CAMERA.delay_ms`: exposed so much later, with stamps of its own.",
)
@click.option("--start", "start_s", type=float, metavar="S", help="Skip the first S seconds of a file or sequence.")
@click.option(
    "--duration",
    "duration_s",
    type=float,
    metavar="S",
    help=f"Length.  [default: {DEFAULT_DURATION_S:g} s; files: whole]",
)
@click.option("--seed", type=int, help="Seed of all that is random.  [default: 0]")
@click.option("--rate", "frame_rate_hz", type=float, metavar="HZ", help="Frames per second.  [default: 20]")
@click.option("--imu-rate", "imu_rate_hz", type=float, metavar="HZ", help="Of the IMU.  [default: the calibration's]")
@click.option(
    "--readout-ms",
    type=float,
    metavar="MS",
    help="Rolling shutter, first row to last, which the calibration says.  [default: the calibration's]",
)
@click.option("--exact-imu", is_flag=True, default=None, help="An IMU without noise and biases.")
@click.option(
    "--rig",
    metavar="mono|stereo|PATH",
    multiple=True,
    shell_complete=_complete_rig,
    help="EuRoC's left camera, both of them, or every camera of a calibration: file or folder; repeat where it is in "
    "several files.  [default: mono]",
)
@click.option("--config", "file", type=FILE, help="Configuration, or manifest of a recording to make again.")
@click.option("--compression", type=click.Choice(["bz2", "lz4", "zstd"]), help="Compress bags.  [default: no]")
@click.option("--workers", type=click.IntRange(1), help="Threads that render.  [default: the number of cores]")
@click.option("--overwrite", is_flag=True, help="Replace a simulated recording of the same name.")
@quiet_option
def simulate(
    destinations: tuple[Path, ...],
    only_list: bool,
    compression: str | None,
    workers: int | None,
    overwrite: bool,
    quiet: bool,
    **choices: Any,
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
        _list_simulations(installed)
        return
    if not destinations:
        raise DatasetError("no destination given: `vioframe simulate flight.bag`; --list shows what there is")
    check_destinations(destinations, compression, overwrite=overwrite)
    config = configuration.complete(_configure(installed, **choices), installed)
    begin_s = perf_counter()
    recording = SimulatedRecording(config, installed, workers or usable_cores())
    with Bar(recording.frame_count, recording.name, quiet=quiet) as bar:
        record(recording, destinations, compression=compression, overwrite=overwrite, on_frame=lambda _: bar())
    if quiet:
        return
    truth, levels = recording.ground_truth, {name: level for name, level in config.conditions.items() if level}
    click.echo(
        f"{recording.name}: {recording.frame_count} frames and {recording.imu_count} IMU samples of "
        f"{truth.duration_s:.1f} s along {truth.path_length_m:.1f} m, in {perf_counter() - begin_s:.0f} s"
    )
    if levels:
        click.echo("conditions: " + ", ".join(f"{name} {level:g}" for name, level in levels.items()))
    click.echo(f"written to {', '.join(map(str, destinations))}; next:\n  vioframe run {destinations[0]}")


def _configure(
    installed: registry.Registry,
    *,
    file: Path | None,
    flight: str | None,
    world: str | None,
    conditions: tuple[str, ...],
    options: tuple[str, ...],
    **values: Any,
) -> SimulationConfig:
    """The configuration file, if any, with the command line's choices over it."""
    config = SimulationConfig() if file is None else configuration.read(file)
    tree = config.model_dump() | {"made": {}}
    if flight is not None:
        tree |= {"flight": SimulationConfig().flight.model_dump(), "trajectory": None, "recorded": None}
        path = Path(flight)
        # What is installed is a flight; anything else that exists, or looks like a path, a file.
        named = flight in installed.names(registry.FLIGHT) or not (path.exists() or path.suffix or os.sep in flight)
        tree |= {"flight": {"name": flight}} if named else {"trajectory": path}
    if world is not None and world != tree["world"]["name"]:
        tree["world"] = {"name": world}
    tree["conditions"] |= parse_levels(conditions)
    tree |= {name: value for name, value in values.items() if value not in (None, ())}
    return configuration.override(validate(SimulationConfig, tree, "command line"), installed, options)


def _list_simulations(installed: registry.Registry) -> None:
    formatter = click.HelpFormatter()
    for kind in (registry.FLIGHT, registry.WORLD):
        with formatter.section(f"{kind.name}s"):
            names = installed.names(kind)
            formatter.write_dl([(name, summary_of(installed.find(kind, name).factory)) for name in names])
    with formatter.section("rigs"):
        formatter.write_dl([(name, f"EuRoC's {', '.join(cameras)}") for name, cameras in RIGS.items()])
    with formatter.section(f"conditions (level 0 to 1; of one camera: CAMERA.NAME, but {', '.join(OF_THE_FLIGHT)})"):
        formatter.write_dl(list(CONDITIONS.items()))
    click.echo(f"{formatter.getvalue()}\nOptions of a flight or world: `vioframe plugins NAME`.")


@click.command("convert")
@click.argument("source", metavar="SRC", type=FILE)
@click.argument("destination", metavar="DST", type=FILE)
@click.option("--format", type=click.Choice(list(FORMATS)), help="Format of DST.  [default: told by its name]")
@click.option(
    "--compression", type=click.Choice(_COMPRESSIONS), help="bz2, lz4 (ros1) or zstd (ros2, mcap).  [default: none]"
)
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Set an option of the reader.")
@calibration_option
@cameras_option("source", "write", "all")
@click.option("--reader", type=PartName("DATASET"), help="Data-set reader, where several accept SRC.")
@quiet_option
def convert(
    source: Path,
    destination: Path,
    format: str | None,
    compression: str | None,
    options: tuple[str, ...],
    calibration: tuple[Path, ...],
    cameras: list[str] | None,
    reader: str | None,
    quiet: bool,
) -> None:
    """Write the recording SRC, whatever a reader opens, to DST in another format.

    \b
    DST tells the format:  NAME.bag    ROS 1 bag
                           NAME.ros2   ROS 2 bag (a folder; so is rosbag2...)
                           NAME.mcap   MCAP file
                           NAME        ASL folder, as EuRoC's

    Every camera is written (or those of `--cameras`), the IMU, and the ground truth that SRC itself brings; the
    calibration goes to the folder DST.calib, or into the ASL folder.
    """
    format = format or format_of(destination)
    installed = registry.load()
    part, _ = installed.resolve(source, reader)
    chosen = {name: value for _, name, value in parse_assignments(options, {part.name: part.options})}
    if calibration:
        chosen["calibration"] = list(calibration)
    if cameras:
        chosen["cameras"] = cameras
    dataset = installed.open_dataset(source, part.name, chosen)
    with Bar(dataset.frame_count, dataset.name, quiet=quiet, late=True) as bar:

        def watched() -> Iterator[Measurement]:
            for measurement in dataset.measurements():
                yield measurement
                bar(advance=isinstance(measurement, FrameSet))

        truth = dataset.ground_truth
        done = write_converted(
            watched(), dataset.calibration, destination, truth=truth, format=format, compression=compression
        )
    if done.unreadable:
        print_notes([f"left out: {done.unreadable} frames or samples of {source} that could not be read"])
    if quiet:
        return
    count = len(dataset.calibration.cameras)
    of_cameras = f" of {count} cameras" if count > 1 else ""
    click.echo(
        f"{destination}: {FORMATS[format].description}, {done.frames} frames{of_cameras}, "
        f"{done.imu_samples} IMU samples, {done.true_poses or 'no'} true poses"
    )
