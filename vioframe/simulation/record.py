"""A simulated recording written to disk: bags and ASL folders, each with its manifest, its world and its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path

from pydantic_core import to_jsonable_python

from vioframe.errors import DatasetError
from vioframe.io.calibration import write_calibration
from vioframe.io.convert import FORMATS, format_of, write_recording, write_sidecar
from vioframe.io.replace import appearing
from vioframe.io.trajectories import write_euroc
from vioframe.parts.config import to_yaml
from vioframe.runs import machine
from vioframe.simulation.config import MANIFEST, MESH, SIMULATION_FILES, TRUTH, simulation_folder
from vioframe.simulation.recording import SimulatedRecording
from vioframe.simulation.world import write_mesh
from vioframe.types import FrameSet, Measurement


def record(
    recording: SimulatedRecording,
    destinations: Sequence[Path],
    *,
    compression: str | None = None,
    overwrite: bool = False,
    on_frame: Callable[[FrameSet], None] = lambda frames: None,
) -> None:
    """Write ``recording`` to every destination, whose name tells its format; see :func:`vioframe.io.convert.format_of`.

    Beside a bag go ``<bag>.calib`` and ``<bag>.simulation``, the folder of the manifest, the ground truth in EuRoC's
    format and the mesh of the world; an ASL folder holds them itself. All appear once all are complete. Raises
    :class:`DatasetError`, also where a destination exists and ``overwrite`` is not set.
    """
    check_destinations(destinations, compression, overwrite=overwrite)
    names = [camera.name for camera in recording.calibration.cameras]
    with ExitStack() as stack:
        replaced = [_files(path) if overwrite else None for path in destinations]
        begun = [
            (path, stack.enter_context(appearing(path, replace=files)))
            for path, files in zip(destinations, replaced, strict=True)
        ]
        with ExitStack() as opened:
            writers = [
                opened.enter_context(FORMATS[format_of(path)].open(unfinished, compression, names))
                for path, unfinished in begun
            ]
            write_recording(_watched(recording.measurements(), on_frame), recording.ground_truth, writers)
        for path, unfinished in begun:
            if format_of(path) == "asl":
                write_calibration(recording.calibration, unfinished / "mav0")
                _describe(recording, simulation_folder(unfinished))
            else:
                with appearing(simulation_folder(path), replace=SIMULATION_FILES) as folder:
                    _describe(recording, folder)
                write_sidecar(recording.calibration, path)


def check_destinations(destinations: Sequence[Path], compression: str | None, *, overwrite: bool) -> None:
    """Raise :class:`DatasetError` where :func:`record` would not write to one of them."""
    for path in destinations:
        offered = FORMATS[format_of(path)].compressions
        if compression is not None and compression not in offered and offered:
            raise DatasetError(
                f"{path.name} cannot be compressed by {compression}; choose one of: {', '.join(offered)}"
            )
        if path.exists() and not overwrite:
            raise DatasetError(f"{path} exists already; choose another name or pass --overwrite")
        if path.exists() and not simulation_folder(path).is_dir():
            raise DatasetError(f"{path} was not written by the simulator and is not overwritten; choose another name")
    if len({path.absolute() for path in destinations}) < len(destinations):
        raise DatasetError("a destination is named twice")


def _files(path: Path) -> tuple[str, ...]:
    """What a recording of that name holds, where it is a folder."""
    own = FORMATS[format_of(path)].files
    return (*own, *(f"simulation/{name}" for name in SIMULATION_FILES))


def _watched(measurements: Iterable[Measurement], on_frame: Callable[[FrameSet], None]) -> Iterator[Measurement]:
    for measurement in measurements:
        yield measurement
        if isinstance(measurement, FrameSet):
            on_frame(measurement)


def _describe(recording: SimulatedRecording, folder: Path) -> None:
    """The manifest, which makes the recording again, the truth and the world's mesh in a new ``folder``."""
    folder.mkdir()
    made = {
        "name": recording.name,
        "frames": recording.frame_count,
        "imu_samples": recording.imu_count,
        "path_m": round(recording.ground_truth.path_length_m, 6),
        "true_calibration": recording.true_calibration,
        "calibration_told": recording.calibration,
        "vioframe": version("vioframe"),
        "revision": machine.commit(Path(__file__).parent),
    }
    plain = to_jsonable_python(made, fallback=lambda array: array.tolist())
    heading = "# A simulated recording: `vioframe simulate --config FILE NAME` makes it again.\n"
    manifest = heading + to_yaml(recording.config.model_copy(update={"made": plain}))
    (folder / MANIFEST).write_text(manifest, encoding="utf-8")
    write_mesh(recording.world.mesh, folder / MESH)
    write_euroc(recording.ground_truth, folder / TRUTH)
