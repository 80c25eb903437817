"""What a plug-in must provide. Plain protocols: nothing to inherit from, nothing to register but a name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from vioframe.types import (
    Calibration,
    Estimate,
    Float,
    FrameTracks,
    Image,
    ImuSegment,
    Keypoints,
    LoopClosure,
    MapCorrection,
    Measurement,
    Mesh,
    Motion,
    NavState,
    Start,
    Step,
    TrainingStep,
)

if TYPE_CHECKING:
    from vioframe.evaluation import Comparison
    from vioframe.geometry.trajectory import Trajectory


@runtime_checkable
class Detector(Protocol):
    """Finds keypoints in one image. It gets no mask: the front-end keeps the candidates away from live tracks.

    Of what it finds the front-end draws, as strong points are not those that are followed well. One that has
    ``best_first = True`` knows better: its score says how well, and the front-end takes the first.
    """

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` keypoints of ``image`` (H, W) uint8, strongest first."""
        ...


@runtime_checkable
class Backend(Protocol):
    """Estimates motion from inertial segments and feature tracks, one frame at a time.

    Its life is the core's (:mod:`vioframe.estimation.lifecycle`): when it begins, is lost and begins anew. One that has
    ``takes_rigs = True`` is given the tracks of several cameras (``FrameTracks.camera``); others are refused such rigs.
    """

    def begin(self, start: Start) -> None:
        """Forget all that was before, and begin at ``start``."""
        ...

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """Take the readings since the last frame and the tracks of this one; say what is known now.

        ``still`` says that the images show a body at rest; the readings may yet contradict it. Such a frame comes a
        little late, once later images bear it out; those that none has borne out yet when the body moves never come,
        and the next frame has their readings. Raises
        :class:`~vioframe.errors.DivergedError`, saying why, where the estimate can no longer be believed: it is begun
        anew then.
        """
        ...


@runtime_checkable
class LoopCloser(Protocol):
    """Recognises places and takes out the drift between them; a consumer of the main loop's steps, of any back-end."""

    def add(self, step: Step) -> MapCorrection | None:
        """Take in one frame and its estimate, quickly: long work belongs into a thread or process beside the loop.

        Returns the correction so far, for this frame's pose; None from who corrects at the end only. That and the
        result may depend on the steps only, not on how long anything took.
        """
        ...

    def finish(self) -> LoopClosure:
        """The corrected poses of all tracked frames; called once, after the last step."""
        ...


@runtime_checkable
class Dataset(Protocol):
    """A recorded flight, read once from front to back."""

    @property
    def name(self) -> str:
        """Short name, such as ``MH_05_difficult``."""
        ...

    @property
    def calibration(self) -> Calibration:
        """The cameras that are read, in the order of the images in a frame set, and the IMU."""
        ...

    @property
    def frame_count(self) -> int | None:
        """Number of frame sets, for progress bars; None where it is not known."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """The body's true trajectory where the data set itself brings one in the body frame, else None.

        Where velocity and biases are known too, it may be a :class:`vioframe.io.trajectories.TrueTrajectory`.
        """
        ...

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frame sets in roughly ascending order of their stamps, and what could not be read.

        Images of one stamp come in one set, those with stamps of their own in sets of their own.
        """
        ...


class DatasetFactory(Protocol):
    """Opens a recording. Usually the data set's class itself, with ``accepts`` as a static method."""

    def __call__(self, path: Path, *args: Any, **options: Any) -> Dataset:
        """Open ``path``; raises :class:`vioframe.errors.DatasetError` where it cannot be read."""
        ...

    def accepts(self, path: Path) -> bool:
        """Whether ``path`` looks like this reader's format (a look at names and magic bytes, no parsing)."""
        ...


@runtime_checkable
class Source(Dataset, Protocol):
    """Sensors that bring what they measure as it happens: a camera that is plugged in, or what stands for one.

    ``measurements`` blocks until something comes, in any order that a :class:`~vioframe.odometry.Odometry` takes, and
    ends where nothing more will. It raises :class:`~vioframe.errors.SourceError` where the device is not there, or not
    any more; asked anew it looks for it again. Nothing is started before it, or ``calibration``, is asked for.
    """

    def tell(self, state: NavState) -> None:
        """Hear where the body is, at up to 200 Hz, in the thread that reads: for those who publish it, quickly."""
        ...

    def close(self) -> None:
        """Let go of the device, for good; from any thread: ``measurements`` ends within a second."""
        ...


@runtime_checkable
class Flight(Protocol):
    """A motion known exactly, for simulation."""

    @property
    def duration_s(self) -> float:
        """How long it lasts: the motion is known from 0 to ``duration_s``."""
        ...

    def at(self, t_s: Float) -> Motion:
        """Pose, velocity, acceleration and angular rate of the body at times ``t_s`` (N,)."""
        ...


@runtime_checkable
class World(Protocol):
    """What a simulated camera sees."""

    @property
    def mesh(self) -> Mesh:
        """Its surfaces, in W."""
        ...

    @property
    def textures(self) -> tuple[Image, ...]:
        """The images on its surfaces, which the mesh refers to by their place here."""
        ...


@runtime_checkable
class Metric(Protocol):
    """Says in numbers how good an estimated trajectory is."""

    def measure(self, comparison: Comparison) -> Mapping[str, float]:
        """Figures by name, a name ending in its unit (``ate_m``, ``inside_y_percent``) unless it is a pure number.

        What cannot be told of this flight is left out; raises :class:`vioframe.errors.TrajectoryError`, one line
        saying why, where that is everything.
        """
        ...


@runtime_checkable
class Trainer(Protocol):
    """Trains what a learned part needs."""

    def train(self) -> Iterator[TrainingStep]:
        """Train to the end, step by step; what is done when it is stopped can be gone on with."""
        ...


DetectorFactory = Callable[..., Detector]
BackendFactory = Callable[..., Backend]
LoopCloserFactory = Callable[..., LoopCloser]
SourceFactory = Callable[..., Source]
FlightFactory = Callable[..., Flight]
WorldFactory = Callable[..., World]
MetricFactory = Callable[..., Metric]
TrainerFactory = Callable[..., Trainer]
