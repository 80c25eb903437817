"""What a sequence is flown on: a recording that is at hand, its images rendered anew, or a simulated stand-in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from vioframe.bench.suites import fingerprints
from vioframe.errors import ConfigError, DatasetError
from vioframe.parts.config import PartConfig
from vioframe.parts.options import did_you_mean
from vioframe.parts.registry import FLIGHT, Registry
from vioframe.runs.results import Data
from vioframe.simulation import config as simulation
from vioframe.simulation.config import RigName, SimulationConfig, made_of, simulation_folder
from vioframe.simulation.scenario import motion_files
from vioframe.simulation.seeds import purpose_of

DEFAULT_STAND_IN_S = 30.0
# EuRoC's own site has MACHINE/SEQUENCE/SEQUENCE.bag.
_DEPTH = 3


class Euroc(NamedTuple):
    """What is known of a sequence of EuRoC (Burri et al., IJRR 2016) without having it.

    ``start_s`` skips the shaking and resting before the take-off, as OpenVINS' evaluations do. The rest is of a
    simulated tour in its place, with the length of the sequence, its path and turning within a few per cent, and the
    light of its hall. It is not that flight, and what is measured on it says nothing about EuRoC's images.
    """

    start_s: float
    duration_s: float
    mean_speed_m_s: float
    width_m: float
    height_m: float
    conditions: Mapping[str, float]


EUROC = {
    "MH_01_easy": Euroc(40.0, 142.0, 0.6, 10.0, 3.0, {}),
    "MH_02_easy": Euroc(35.0, 115.0, 0.64, 10.0, 3.0, {}),
    "MH_03_medium": Euroc(5.0, 127.0, 1.03, 12.0, 3.0, {}),
    "MH_04_difficult": Euroc(10.0, 89.0, 1.03, 15.0, 3.0, {"low_light": 0.3}),
    "MH_05_difficult": Euroc(5.0, 106.0, 0.92, 15.0, 3.0, {"low_light": 0.3}),
    "V1_01_easy": Euroc(0.0, 144.0, 0.41, 5.0, 1.5, {}),
    "V1_02_medium": Euroc(0.0, 84.0, 0.91, 5.0, 1.5, {}),
    "V1_03_difficult": Euroc(0.0, 105.0, 0.75, 4.0, 1.5, {"motion_blur": 0.3}),
    "V2_01_easy": Euroc(0.0, 112.0, 0.33, 4.0, 1.5, {}),
    "V2_02_medium": Euroc(0.0, 115.0, 0.72, 5.0, 1.5, {}),
    "V2_03_difficult": Euroc(0.0, 115.0, 0.75, 5.0, 1.5, {"motion_blur": 0.3}),
}


def tour(name: str) -> PartConfig:
    """The simulated flight that stands in for a sequence of EuRoC's, a route of its own at the same speed."""
    known, route = EUROC[name], 1 + list(EUROC).index(name)
    options: dict[str, Any] = {"route": route, "mean_speed_m_s": known.mean_speed_m_s}
    return PartConfig(name="tour", options={**options, "width_m": known.width_m, "height_m": known.height_m})


@dataclass(frozen=True, slots=True)
class Source:
    """What there is of a sequence. ``recording`` holds images; ``motion`` IMU and truth, to render images along.

    ``kind`` is that of the recording; ``ground_truth`` None where the recording brings it itself.
    """

    name: str
    recording: Path | None = None
    kind: Data = Data.REAL
    ground_truth: Path | None = None
    motion: Path | None = None


@dataclass(frozen=True, slots=True)
class Flown:
    """What a task runs on: a recording that exists, or one to be simulated first. ``digest`` tells it from others."""

    data: Data
    note: str
    start_s: float
    digest: str
    recording: Path | None = None
    ground_truth: Path | None = None
    simulated: SimulationConfig | None = None


def find_source(name: str, folders: Sequence[Path], installed: Registry) -> Source:
    """What ``folders`` hold of the sequence ``name``; raises :class:`DatasetError` for one that nothing is known of."""
    candidates = list(_candidates(name, folders))
    recording = next(filter(_has_images, candidates), None)
    motion = next(filter(_is_motion, candidates), None)
    if recording is not None:
        kind, truth = _kind_of(recording, installed), _truth_of(recording, motion, installed)
        return Source(name, recording, kind, truth, motion)
    if motion is None and name not in (known := [*EUROC, *installed.names(FLIGHT)]):
        where = f" in {', '.join(map(str, folders))}" if folders else "; --data DIR says where recordings are"
        hint = did_you_mean(name, known)
        raise DatasetError(f"there is no {name}.bag or {name}/mav0{where}{hint}, and no simulated flight for it")
    return Source(name, motion=motion)


def flown(
    source: Source,
    *,
    start_s: float | None,
    duration_s: float | None,
    conditions: Mapping[str, float],
    rig: RigName,
    seed: int,
    installed: Registry,
) -> Flown:
    """What to fly ``source`` on; under ``conditions`` images are rendered.

    ``rig`` and ``seed`` are those of what is simulated or rendered.
    """
    name, known = source.name, EUROC.get(source.name)
    begin_s = start_s if start_s is not None else known.start_s if known else 0.0
    if source.recording is not None and (not conditions or source.kind is not Data.REAL):
        if conditions:
            raise ConfigError(f"{source.recording} is a simulation already: conditions need the real recording")
        what = {
            Data.REAL: "recorded images and IMU",
            Data.RENDERED: "recorded IMU and motion, images rendered",
            Data.SIMULATED: "simulated motion, IMU and images",
        }
        files = [source.recording] if source.ground_truth is None else [source.recording, source.ground_truth]
        digest = fingerprints.of_recordings(files)
        note = f"{name}: {what[source.kind]}"
        if (made := made_of(source.recording)) and (purpose := purpose_of(made.seed)) not in (None, "reporting"):
            note += f", in world {made.seed}, which is for {purpose} and not for reporting"
        return Flown(source.kind, note, begin_s, digest, source.recording, source.ground_truth)
    data, note = Data.SIMULATED, f"simulated flight {name}"
    settings: dict[str, Any] = {"seed": seed, "rig": (rig,), "conditions": dict(conditions)}
    if source.motion is not None:
        data = Data.RENDERED
        note = f"{name}: its recorded IMU and motion, images rendered along them; not its own images"
        settings |= {"recorded": source.motion, "duration_s": None if duration_s is None else begin_s + duration_s}
    elif known is not None:
        note = f"a simulated flight stands in for {name}: its speed and light, not its path"
        # It begins at its beginning: there is no shaking before the take-off to be skipped.
        begin_s = 0.0
        settings |= {
            "flight": tour(name),
            "duration_s": min(known.duration_s, duration_s or known.duration_s),
            "conditions": {**known.conditions, **conditions},
        }
    else:
        settings |= {"flight": PartConfig(name=name), "duration_s": begin_s + (duration_s or DEFAULT_STAND_IN_S)}
    config = simulation.complete(SimulationConfig(**settings), installed)
    # Where the motion lies says nothing about it.
    plain = config.model_copy(update={"recorded": None, "made": {}}).model_dump(mode="json")
    files = [] if config.recorded is None else [*motion_files(config.recorded)]
    return Flown(data, note, begin_s, fingerprints.of_recordings(files, plain), simulated=config)


def _candidates(name: str, folders: Iterable[Path]) -> Iterator[Path]:
    """Existing paths that may be the sequence, those nearest to the folders first."""
    for folder in folders:
        if not folder.is_dir():
            raise DatasetError(f"--data {folder} is no folder; name the one that holds the recordings")
        if folder.resolve().name == name:
            yield folder
        for depth in range(_DEPTH):
            for suffix in (".bag", ".mcap", ".ros2", ""):
                yield from sorted(folder.glob("*/" * depth + name + suffix))


def _has_images(path: Path) -> bool:
    if path.is_dir() and path.suffix != ".ros2":
        return (path / "mav0" / "cam0" / "data").is_dir()
    return True


def _is_motion(path: Path) -> bool:
    """Whether ``path`` holds IMU readings, stamps of frames and a ground truth to render along."""
    if not path.is_dir():
        return False
    try:
        motion_files(path)
    except DatasetError:
        return False
    return True


def _kind_of(recording: Path, installed: Registry) -> Data:
    """A recording of vioframe's simulator says so itself, by what lies beside it."""
    if (made := made_of(recording)) is not None:
        return Data.RENDERED if made.recorded is not None else Data.SIMULATED
    if recording.is_file() and installed.open_dataset(recording).ground_truth is not None:
        raise DatasetError(
            f"{recording} holds ground truth, so the simulator wrote it, but {simulation_folder(recording).name} with "
            "what it was made of is not beside it; copy that too"
        )
    return Data.REAL


def _truth_of(recording: Path, motion: Path | None, installed: Registry) -> Path | None:
    """A file of the ground truth, None where the recording brings it; raises :class:`DatasetError` for neither."""
    if motion is not None:
        return motion_files(motion)[2]
    if installed.open_dataset(recording).ground_truth is not None:
        return None
    raise DatasetError(
        f"{recording} comes without ground truth, as EuRoC's bags do; put the sequence's ASL folder "
        f"{recording.stem}/mav0/state_groundtruth_estimate0 beside it"
    )
