"""What a sequence is flown on: a recording that is at hand, its images rendered anew, or a simulated stand-in."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vioframe.bench.suites.euroc import EUROC
from vioframe.errors import ConfigError, DatasetError
from vioframe.io.calibration import sidecar_folder
from vioframe.parts.config import PartConfig
from vioframe.parts.options import did_you_mean
from vioframe.parts.registry import FLIGHT, Registry
from vioframe.report.suite.results import Data
from vioframe.simulation import config as simulation
from vioframe.simulation.config import MANIFEST, SimulationConfig, simulation_folder
from vioframe.simulation.scenario import GROUND_TRUTH_FILES, find_file, motion_files, sensor_folder

DEFAULT_STAND_IN_S = 30.0
# EuRoC's own site has MACHINE/SEQUENCE/SEQUENCE.bag.
_DEPTH = 3
_SAMPLE_BYTES = 1 << 20


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
    """What a task runs on: a recording that exists, or one to be simulated first."""

    data: Data
    note: str
    start_s: float
    recording: Path | None = None
    ground_truth: Path | None = None
    simulated: SimulationConfig | None = None


def find_source(name: str, folders: Sequence[Path], installed: Registry) -> Source:
    """What ``folders`` hold of the sequence ``name``; raises :class:`DatasetError` for one that nothing is known of."""
    recording, kind, motion = None, Data.REAL, None
    for path in _candidates(name, folders):
        if recording is None and _has_images(path):
            recording, kind = path, _kind_of(path, installed)
        if motion is None and _is_motion(path):
            motion = path
    known = name in EUROC or name in installed.names(FLIGHT)
    if recording is None and motion is None and not known:
        where = f" in {', '.join(map(str, folders))}" if folders else "; --data DIR says where recordings are"
        hint = did_you_mean(name, [*EUROC, *installed.names(FLIGHT)])
        raise DatasetError(f"there is no {name}.bag or {name}/mav0{where}{hint}, and no simulated flight for it")
    truth = None
    if recording is not None:
        truth = _truth_of(recording, motion, installed)
    return Source(name, recording, kind, truth, motion)


def flown(
    source: Source,
    *,
    start_s: float | None,
    duration_s: float | None,
    conditions: Mapping[str, float],
    seed: int,
    installed: Registry,
) -> Flown:
    """What to fly ``source`` on. Under ``conditions`` images are rendered; the seed is that of what is simulated."""
    known = EUROC.get(source.name)
    begin_s = start_s if start_s is not None else known.start_s if known else 0.0
    if source.recording is not None and (not conditions or source.kind is not Data.REAL):
        if conditions:
            raise ConfigError(f"{source.recording} is a simulation already: conditions need the real recording")
        note = {
            Data.REAL: f"{source.name}: recorded images and IMU",
            Data.RENDERED: f"{source.name}: recorded IMU and motion, images rendered",
            Data.SIMULATED: f"{source.name}: simulated motion, IMU and images",
        }[source.kind]
        return Flown(source.kind, note, begin_s, source.recording, source.ground_truth)
    if source.motion is not None:
        config = SimulationConfig(
            recorded=source.motion,
            duration_s=None if duration_s is None else begin_s + duration_s,
            seed=seed,
            conditions=dict(conditions),
        )
        note = f"{source.name}: its recorded IMU and motion, images rendered along them; not EuRoC's images"
        return Flown(Data.RENDERED, note, begin_s, simulated=simulation.complete(config, installed))
    flight = known.stand_in.flight if known else PartConfig(name=source.name)
    usual_s = known.stand_in.duration_s if known else DEFAULT_STAND_IN_S
    # A stand-in begins at its beginning: there is no shaking before the take-off to be skipped.
    start_s = 0.0 if known or start_s is None else start_s
    config = SimulationConfig(
        flight=flight,
        duration_s=min(usual_s, duration_s or usual_s) if known else start_s + (duration_s or usual_s),
        seed=seed,
        conditions={**(known.stand_in.conditions if known else {}), **conditions},
    )
    stands_in = f"a simulated flight stands in for {source.name}: its speed and light, not its path"
    note = stands_in if known else f"simulated flight {source.name}"
    return Flown(Data.SIMULATED, note, start_s, simulated=simulation.complete(config, installed))


def fingerprint(flown: Flown) -> str:
    """Tells data from other data: of a recording its files' names, sizes and samples of their bytes."""
    if flown.simulated is not None:
        # Where the motion lies says nothing about it.
        motion = flown.simulated.recorded
        plain = flown.simulated.model_copy(update={"recorded": None, "made": {}}).model_dump_json()
        return fingerprint_of([] if motion is None else motion_files(sensor_folder(motion)), plain)
    assert flown.recording is not None
    return fingerprint_of([flown.recording] if flown.ground_truth is None else [flown.recording, flown.ground_truth])


def fingerprint_of(paths: Iterable[Path], text: str = "") -> str:
    """Of recordings with the calibration beside them, of other files, and of a text."""
    digest = hashlib.sha256(text.encode())
    for path in paths:
        _add_files(digest, [*_files_of(path), *_files_of(sidecar_folder(path))])
    return digest.hexdigest()[:16]


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
        motion_files(sensor_folder(path))
    except DatasetError:
        return False
    return True


def _kind_of(recording: Path, installed: Registry) -> Data:
    """A recording of vioframe's simulator says so itself, by what lies beside it."""
    manifest = simulation_folder(recording) / MANIFEST
    if not manifest.is_file():
        if recording.is_file() and installed.open_dataset(recording).ground_truth is not None:
            raise DatasetError(
                f"{recording} holds ground truth, so the simulator wrote it, but {manifest.parent.name} with what it "
                "was made of is not beside it; copy that too"
            )
        return Data.REAL
    return Data.RENDERED if simulation.read(manifest).recorded is not None else Data.SIMULATED


def _truth_of(recording: Path, motion: Path | None, installed: Registry) -> Path | None:
    """A file of the ground truth, None where the recording brings it; raises :class:`DatasetError` for neither."""
    if motion is not None:
        return find_file(sensor_folder(motion), GROUND_TRUTH_FILES)
    if installed.open_dataset(recording).ground_truth is not None:
        return None
    raise DatasetError(
        f"{recording} comes without ground truth, as EuRoC's bags do; put the sequence's ASL folder "
        f"{recording.stem}/mav0/state_groundtruth_estimate0 beside it"
    )


def _files_of(recording: Path) -> list[Path]:
    """The files that tell a recording; none where there is nothing."""
    if recording.is_file():
        return [recording]
    # Thousands of images: the list of their stamps, and the readings, tell the sequence as well.
    images = [path for path in recording.rglob("*") if path.is_file() and path.suffix not in (".png", ".jpg")]
    return sorted(images)


def _add_files(digest: hashlib._Hash, paths: Iterable[Path]) -> None:
    for path in paths:
        size = path.stat().st_size
        digest.update(f"{path.name} {size}\n".encode())
        with path.open("rb") as file:
            for at in (0, size // 2, max(size - _SAMPLE_BYTES, 0)):
                file.seek(at)
                digest.update(file.read(_SAMPLE_BYTES))
