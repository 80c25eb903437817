"""What the benchmark scripts share: their options, running back-ends on tracks, and what is printed and kept."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from vioframe.bench import Row, backend_row, record, run_backend
from vioframe.cores import limited_threads, usable_cores
from vioframe.errors import VioframeError
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.incidents import Incidents
from vioframe.interfaces import Dataset, Detector
from vioframe.io.synchronise import synchronise
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, PartConfig
from vioframe.parts.registry import Registry
from vioframe.simulation import TrackSequence
from vioframe.simulation.config import SimulationConfig, complete
from vioframe.simulation.record import record as write_recording
from vioframe.simulation.recording import SimulatedRecording

HERE = Path(__file__).resolve().parent
SHARED_DATA = HERE.parents[1] / "shared" / "data"

BACKEND_COLUMNS = {
    "sequence": "",
    "seed": "",
    "path_m": ".1f",
    "ate_m": ".4f",
    "percent": ".3f",
    "scale": ".4f",
    "yaw_deg": ".2f",
    "initialised_s": ".2f",
    "completion": ".1%",
    "resets": "d",
    "cpu_ms": ".2f",
    "stage_ms.total": ".2f",
}

bags_option = click.option(
    "--bags",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder in which recordings are kept, and found again; default: none are kept.",
)


def script(command: Callable[..., None]) -> click.Command:
    """A script, of which a :class:`VioframeError` becomes one line and exit code 2."""

    @wraps(command)
    def checked(**arguments: Any) -> None:
        try:
            command(**arguments)
        except VioframeError as error:
            click.echo(f"error: {error}", err=True)
            sys.exit(2)

    return click.command()(checked)


def benchmark(command: Callable[..., None]) -> click.Command:
    """A :func:`script` with the options that most of them have."""
    for option in (
        click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results."),
        click.option("-o", "--option", "assignments", multiple=True, metavar="KEY=VALUE", help="Set a part's option."),
        click.option("--backend", default="msckf", show_default=True, help="Back-end to run."),
        click.option(
            "--data",
            type=click.Path(exists=True, file_okay=False, path_type=Path),
            default=SHARED_DATA,
            help="Folder of the recordings.  [default: ../shared/data]",
        ),
    ):
        command = option(command)
    return script(command)


def backend_rows(
    sequences: Iterable[tuple[Row, TrackSequence]], backend: str, assignments: Sequence[str]
) -> Iterator[Row]:
    """A row for each sequence, with the values that come with it first."""
    installed = registry.load()
    config = configuration.override(Config(backend=PartConfig(name=backend)), installed, assignments)
    for about, sequence in sequences:
        estimator = installed.create_backend(backend, config.backend.options)
        # Small matrices: more threads only wait for one another. Set here, when every BLAS has been loaded.
        with threadpool_limits(1):
            run = run_backend(sequence, estimator, config.estimation_options)
        yield {**about, **backend_row(sequence, run)}


def render(simulated: SimulationConfig, installed: Registry, bag: Path) -> None:
    """Write the recording that ``simulated`` describes to ``bag``, in place of one that is there."""
    recording = SimulatedRecording(complete(simulated, installed), installed, usable_cores())
    write_recording(recording, [bag], overwrite=True)


def tracked(dataset: Dataset, detector: Detector, options: FrontendOptions | None = None) -> TrackSequence:
    """What the front-end makes of the points of ``detector`` in the images of ``dataset`` that its truth covers."""
    calibration, truth, incidents = dataset.calibration, dataset.ground_truth, Incidents()
    assert truth is not None
    frontend = Frontend(detector, calibration, options or FrontendOptions(), incidents)
    offset_ns = calibration.cameras[0].time_offset_ns
    with limited_threads():
        packets = tuple(
            (imu, frontend.track(imu, frames, calibration))
            for imu, frames in synchronise(dataset.measurements(), incidents, time_offset_ns=offset_ns)
            if truth.covers([frames.t_ns])[0]
        )
    return TrackSequence(dataset.name, calibration, packets, truth)


def present(
    name: str, title: str, rows: Iterable[Row], columns: Mapping[str, str], settings: Mapping[str, Any], keep: bool
) -> None:
    """Print the table, and write it to :func:`results_file` if asked to."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)  # a file or pipe has no width of its own
    done = []
    with console.status(f"{name} ...") as status:
        for row in rows:
            done.append(row)
            status.update(f"{name}: {len(done)} done")
    console.print(table(title, done, columns))
    if keep:
        path = results_file(name, settings)
        record(path, done, settings)
        console.print(f"written to {path.relative_to(HERE.parent)}")


def table(title: str, rows: Sequence[Row], columns: Mapping[str, str]) -> Table:
    """``columns`` maps keys (``stage_ms.total`` reaches into ``stage_ms``) to format specifications."""
    out = Table(title=title)
    for key, spec in columns.items():
        out.add_column(key, justify="right" if spec else "left", no_wrap=True)
    for row in rows:
        values = [_found(row, key) for key in columns]
        cells = zip(values, columns.values(), strict=True)
        out.add_row(*("-" if value is None else format(value, spec) for value, spec in cells))
    return out


def _found(row: Row, key: str) -> Any:
    """What ``row`` has under ``key``, with a dot for each mapping within; None where there is no such thing."""
    found: Any = row
    for part in key.split("."):
        found = (found or {}).get(part)
    return found


def results_file(name: str, settings: Mapping[str, Any]) -> Path:
    """``results/NAME_BACKEND.json``, or without the back-end where none takes part."""
    parts = [name, settings["backend"]] if "backend" in settings else [name]
    return HERE / "results" / f"{'_'.join(parts)}.json"
