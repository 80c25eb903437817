"""``vioframe convert``: a recording in another format."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vioframe.interfaces import Dataset
from vioframe.io.convert import FORMATS, convert, format_of
from vioframe.parts import registry
from vioframe.parts.config import parse_assignments
from vioframe.types import FrameSet, Measurement

_FILE = click.Path(path_type=Path)
_COMPRESSIONS = sorted({name for format in FORMATS.values() for name in format.compressions})


@click.command("convert")
@click.argument("source", metavar="SRC", type=_FILE)
@click.argument("destination", metavar="DST", type=_FILE)
@click.option("--format", type=click.Choice(list(FORMATS)), help="Format of DST.  [default: told by its name]")
@click.option(
    "--compression", type=click.Choice(_COMPRESSIONS), help="bz2, lz4 (ros1) or zstd (ros2, mcap).  [default: none]"
)
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Set an option of the reader.")
@click.option("--calibration", type=_FILE, multiple=True, help="Calibration file; repeat where it is in several.")
@click.option("--reader", metavar="NAME", help="Data-set reader, where several accept SRC.")
def command(
    source: Path,
    destination: Path,
    format: str | None,
    compression: str | None,
    options: tuple[str, ...],
    calibration: tuple[Path, ...],
    reader: str | None,
) -> None:
    """Write the recording SRC, whatever a reader opens, to DST in another format.

    \b
    DST tells the format:  NAME.bag    ROS 1 bag
                           NAME.ros2   ROS 2 bag (a folder; so is rosbag2...)
                           NAME.mcap   MCAP file
                           NAME        ASL folder, as EuRoC's

    Every camera is written (or those of `-o cameras=[cam0,cam1]`), the IMU, and the ground truth that SRC itself
    brings; the calibration goes to the folder DST.calib, or into the ASL folder.
    """
    format = format or format_of(destination)
    installed = registry.load()
    part = installed.find_reader(source, reader)
    chosen = {name: value for _, name, value in parse_assignments(options, {part.name: part.options})}
    if calibration:
        chosen["calibration"] = list(calibration)
    dataset = installed.open_dataset(source, part.name, chosen)
    progress = _progress()
    try:
        done = convert(
            _watched(dataset, progress),
            dataset.calibration,
            destination,
            truth=dataset.ground_truth,
            format=format,
            compression=compression,
        )
    finally:
        if progress.tasks:
            progress.stop()
    cameras = len(dataset.calibration.cameras)
    of_cameras = f" of {cameras} cameras" if cameras > 1 else ""
    click.echo(
        f"{destination}: {FORMATS[format].description}, {done.frames} frames{of_cameras}, "
        f"{done.imu_samples} IMU samples, {done.true_poses or 'no'} true poses"
    )
    if done.unreadable:
        click.echo(f"left out: {done.unreadable} frames or samples of {source} that could not be read")


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))


def _watched(dataset: Dataset, progress: Progress) -> Iterator[Measurement]:
    """The measurements themselves, the progress bar moving with each frame."""
    task = None
    for measurement in dataset.measurements():
        if task is None:
            # Not before: an error ahead of the first measurement is then one line and nothing else.
            task = progress.add_task(dataset.name, total=dataset.frame_count)
            progress.start()
        yield measurement
        if isinstance(measurement, FrameSet):
            progress.advance(task)
