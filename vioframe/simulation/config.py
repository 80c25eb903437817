"""What is to be simulated: YAML in, a frozen and validated :class:`SimulationConfig` out.

A recording comes with the folder of what it was made of: ``flight.bag.simulation`` beside ``flight.bag``, or
``simulation`` in an ASL folder.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from vioframe.io.calibration import load_calibration, packaged_calibration
from vioframe.parts.config import PartConfig, Section, parse_assignments, read_tree, validate
from vioframe.parts.options import Option, options_of, validate_options
from vioframe.parts.registry import FLIGHT, WORLD, Kind, Registry
from vioframe.simulation.conditions import check_levels
from vioframe.simulation.imu import ImuErrors
from vioframe.types import Calibration

MANIFEST, TRUTH, MESH = SIMULATION_FILES = "manifest.yaml", "ground_truth.csv", "world.ply"
"""Files of a simulation's folder: all settings, the exact states in EuRoC's format, and the mesh of the world in W."""


RigName = Literal["mono", "stereo"]
RIGS = {"mono": ("cam0",), "stereo": ("cam0", "cam1")}
"""EuRoC's cameras by the name of a rig of them."""

_DELAY = Option("delay_ms", float, 0.0, "later than the frame's time, with a stamp of its own")


class SimulationConfig(Section):
    """Everything that determines a simulated recording.

    The motion is a ``flight`` by name, the file ``trajectory``, or that of the EuRoC sequence ``recorded``, whose
    readings of the IMU are then taken as they are. ``rig`` is one of :data:`RIGS`, or the files of a calibration.
    ``delay_ms`` says how much later than the frame's time a camera of the rig, by its name, takes its image: with a
    stamp of its own. ``readout_ms`` is that of a rolling shutter, which the estimator is told of, in place of the
    calibration's. What the worlds of a ``seed`` are for is in :mod:`vioframe.simulation.seeds`. ``made`` is what came
    of it, in a manifest; nothing reads it.
    """

    flight: PartConfig = PartConfig(name="figure_eight")
    trajectory: Path | None = None
    recorded: Path | None = None
    start_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    duration_s: Annotated[float | None, Field(gt=0.0, allow_inf_nan=False)] = None
    seed: Annotated[int, Field(ge=0)] = 0
    frame_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 20.0
    imu_rate_hz: Annotated[float | None, Field(gt=0.0, le=10_000.0)] = None
    readout_ms: Annotated[float | None, Field(ge=-200.0, le=200.0)] = None
    exact_imu: bool = False
    imu: dict[str, Any] = Field(default_factory=dict)
    world: PartConfig = PartConfig(name="hall")
    conditions: dict[str, float] = Field(default_factory=dict)
    rig: Annotated[tuple[str, ...], Field(min_length=1)] = ("mono",)
    delay_ms: dict[str, Annotated[float, Field(ge=0.0, le=1000.0)]] = Field(default_factory=dict)
    made: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        if self.trajectory is not None and self.recorded is not None:
            raise ValueError("give a trajectory or a recorded sequence, not both")
        if self.recorded is not None and (self.imu or self.exact_imu or self.imu_rate_hz is not None):
            raise ValueError("the readings of a recorded sequence are taken as they are; leave the IMU's settings out")
        if self.start_s and self.trajectory is None and self.recorded is None:
            raise ValueError("--start is for trajectories and recorded sequences; a flight begins at its beginning")
        return self


def read(path: Path) -> SimulationConfig:
    """Read a configuration, or the manifest of a simulated recording; raises :class:`ConfigError`."""
    return validate(SimulationConfig, read_tree(path), str(path))


def override(config: SimulationConfig, registry: Registry, assignments: Iterable[str]) -> SimulationConfig:
    """``config`` with options of the flight, the world, the IMU or a camera set from ``key=value`` texts."""
    options = {camera.name: [_DELAY] for camera in rig_of(config).cameras}
    options |= {"world": registry.find(WORLD, config.world.name).options, "imu": options_of(ImuErrors)}
    if config.trajectory is None and config.recorded is None:
        options["flight"] = registry.find(FLIGHT, config.flight.name).options
    tree = config.model_dump()
    for section, name, value in parse_assignments(assignments, options):
        if section in ("world", "flight"):
            tree[section]["options"][name] = value
        elif section == "imu":
            tree["imu"][name] = value
        else:
            tree[name][section] = value
    return validate(SimulationConfig, tree, "command line")


def is_named(rig: tuple[str, ...]) -> bool:
    """Whether it is one of :data:`RIGS`, which come before files of the same name."""
    return len(rig) == 1 and rig[0] in RIGS


def rig_of(config: SimulationConfig) -> Calibration:
    """The cameras and the IMU that are simulated; raises :class:`CalibrationError`."""
    if is_named(config.rig):
        return packaged_calibration("euroc", cameras=RIGS[config.rig[0]])
    return load_calibration(*config.rig)


def complete(config: SimulationConfig, registry: Registry) -> SimulationConfig:
    """``config`` with every option checked, coerced and its default filled in, and paths made absolute."""

    def completed(part: PartConfig, kind: Kind) -> PartConfig:
        return PartConfig(name=part.name, options=registry.find(kind, part.name).validate(part.options))

    check_levels(config.conditions)
    parts: dict[str, Any] = {
        "world": completed(config.world, WORLD),
        "trajectory": config.trajectory and config.trajectory.absolute(),
        "recorded": config.recorded and config.recorded.absolute(),
        "rig": config.rig if is_named(config.rig) else tuple(str(Path(path).absolute()) for path in config.rig),
    }
    if config.recorded is None:
        parts["imu"] = validate_options("the IMU", ImuErrors, config.imu)
        if config.trajectory is None:
            parts["flight"] = completed(config.flight, FLIGHT)
    return config.model_copy(update=parts)


def made_of(recording: Path) -> SimulationConfig | None:
    """What a simulated recording was made of, as its manifest says; None for any other."""
    manifest = simulation_folder(recording) / MANIFEST
    return read(manifest) if manifest.is_file() else None


def simulation_folder(recording: Path) -> Path:
    """Where a simulated recording keeps what it was made of, whether there is one or not."""
    recording = recording.absolute()
    if (recording / "mav0").is_dir():
        return recording / "simulation"
    return recording.with_name(f"{recording.name}.simulation")
