"""What of a recording is looked at: every stamp and reading, a few figures of each image, tracks where it moves most.

A :class:`Gatherer` takes the measurements one by one, so that a run can let one listen; :func:`gather` reads a whole
recording, and follows points through the stretches with the most motion.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from vioframe.arrays import Bool, same_image
from vioframe.errors import ImageSizeError
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.incidents import Incidents
from vioframe.io.images import check_size
from vioframe.types import (
    NS_PER_S,
    Calibration,
    Float,
    FrameSet,
    FrameTracks,
    Image,
    ImuSample,
    ImuSegment,
    Int,
    Keypoints,
    Measurement,
)

# Points are followed through stretches of this length; of those the ones with the most motion are kept.
_STRETCH_S, _MOST_STRETCHES, _MOST_FRAMES_A_STRETCH = 2.0, 16, 64
# A stretch takes the place of the poorest that is kept where it turns by so many times as much.
_WORTH_IT = 1.3
_POINTS = 120
# What ails images ails many: some of them tell.
_LOOK_EVERY = 3
_SATURATED = 250
# The least that a coarse image bends by, in quarters of a grey level: where it does less there is nothing to be sharp.
_LEAST_BEND = 4.0


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """The IMU's, in the order in which they came: ``t_ns`` (N,), ``gyro_B`` (N, 3) and ``accel_B`` (N, 3)."""

    t_ns: Int
    gyro_B: Float
    accel_B: Float

    def sorted(self) -> ImuSamples:
        """Those that are numbers, in the order of their stamps, of one stamp the first."""
        good = np.isfinite(self.gyro_B).all(axis=1) & np.isfinite(self.accel_B).all(axis=1)
        t_ns, first = np.unique(self.t_ns[good], return_index=True)
        return ImuSamples(t_ns, self.gyro_B[good][first], self.accel_B[good][first])


@dataclass(frozen=True, slots=True)
class Look:
    """A few figures of M images: their stamps ``t_ns`` (M,), in the order in which they came.

    ``brightness`` and ``contrast`` (M,) are mean and standard deviation in grey levels, ``bright_share`` (M,) that of
    overexposed pixels, ``sharpness`` (M,) see :func:`sharpness_of`; all NaN for images that were passed over.
    ``repeated`` (M,) says which are the one before to the last bit.
    """

    t_ns: Int
    brightness: Float
    contrast: Float
    bright_share: Float
    sharpness: Float
    repeated: Bool


@dataclass(frozen=True, slots=True)
class Recording:
    """What was gathered: of the first camera of ``calibration``, and the IMU.

    ``stretches`` are runs of consecutive frames with their tracks; ``unreadable`` counts by kind what the reader
    passed over, ``wrong_size`` is what it said of images that do not fit the calibration.
    """

    calibration: Calibration
    imu: ImuSamples
    look: Look
    stretches: tuple[tuple[FrameTracks, ...], ...] = ()
    unreadable: Counter[str] = field(default_factory=Counter)
    wrong_size: ImageSizeError | None = None


class Gatherer:
    """Takes a recording's measurements one by one; looks closely at every ``look_every``-th image only.

    After ``longest_s`` of images no more is taken, so that what is kept does not grow for ever. Points are not followed
    here: see :func:`gather`.
    """

    def __init__(self, calibration: Calibration, look_every: int = 1, longest_s: float = inf) -> None:
        self._calibration, self._look_every = calibration, look_every
        self._longest_ns = longest_s * NS_PER_S
        # Seven numbers a reading, packed: an hour of them takes 40 MB.
        self._imu_ns, self._readings = array("q"), array("d")
        self._frames_ns: list[int] = []
        self._looks: list[tuple[float, float, float, float]] = []
        self._repeated: list[bool] = []
        self._last: Image | None = None
        self._unreadable: Counter[str] = Counter()

    def add(self, measurement: Measurement) -> None:
        if self._frames_ns and measurement.t_ns - self._frames_ns[0] > self._longest_ns:
            return
        if isinstance(measurement, ImuSample):
            self._imu_ns.append(measurement.t_ns)
            self._readings.extend(measurement.gyro_B.tolist())
            self._readings.extend(measurement.accel_B.tolist())
        elif not isinstance(measurement, FrameSet):
            self._unreadable[measurement.kind] += 1
        elif measurement.images and (image := measurement.images[0]) is not None:
            close = len(self._frames_ns) % self._look_every == 0
            self._frames_ns.append(measurement.t_ns)
            self._looks.append(_look(image) if close else (np.nan,) * 4)
            self._repeated.append(self._last is not None and same_image(image, self._last))
            self._last = image

    def turning(self, since: int) -> float:
        """How unsteadily the body turned during the readings from number ``since`` on, rad/s."""
        rates = np.array(self._readings[6 * since :]).reshape(-1, 6)[:, :3]
        return float(np.linalg.norm(rates.std(axis=0))) if len(rates) > 1 else 0.0

    @property
    def readings(self) -> int:
        return len(self._imu_ns)

    def recording(
        self, stretches: Iterable[tuple[FrameTracks, ...]] = (), wrong_size: ImageSizeError | None = None
    ) -> Recording:
        """What was gathered until now."""
        values = np.array(self._readings).reshape(-1, 6)
        imu = ImuSamples(np.array(self._imu_ns), values[:, :3], values[:, 3:])
        brightness, contrast, bright_share, sharpness = np.array(self._looks, np.float64).reshape(-1, 4).T
        look = Look(
            np.array(self._frames_ns, np.int64),
            brightness,
            contrast,
            bright_share,
            sharpness,
            np.array(self._repeated, bool),
        )
        return Recording(self._calibration, imu, look, tuple(stretches), self._unreadable, wrong_size)


def gather(measurements: Iterable[Measurement], calibration: Calibration) -> Recording:
    """Read ``measurements`` to their end, and follow points through the stretches in which the body turns most."""
    calibration = Calibration(calibration.cameras[:1], calibration.imu)
    gatherer = Gatherer(calibration, _LOOK_EVERY)
    kept: list[tuple[float, tuple[FrameTracks, ...]]] = []
    frames: list[FrameSet] = []
    begun = 0

    def close() -> None:
        """End the stretch that ``frames`` are, and keep it if it is worth it."""
        nonlocal begun
        turning = gatherer.turning(begun)
        if len(kept) == _MOST_STRETCHES and turning > _WORTH_IT * min(kept, key=_by_turning)[0]:
            kept.remove(min(kept, key=_by_turning))
        if len(kept) < _MOST_STRETCHES and len(frames) > 1:
            kept.append((turning, _followed(frames, calibration)))
        frames.clear()
        begun = gatherer.readings

    wrong_size = None
    try:
        for measurement in measurements:
            gatherer.add(measurement)
            if isinstance(measurement, FrameSet) and measurement.images and measurement.images[0] is not None:
                check_size(measurement.images[0], calibration.cameras[0].model, "the recording")
                frames.append(FrameSet(measurement.t_ns, measurement.images[:1]))
                if measurement.t_ns - frames[0].t_ns > _STRETCH_S * NS_PER_S or len(frames) >= _MOST_FRAMES_A_STRETCH:
                    close()
    except ImageSizeError as error:
        wrong_size = error
    close()
    return gatherer.recording((stretch for _, stretch in kept), wrong_size)


def _by_turning(stretch: tuple[float, tuple[FrameTracks, ...]]) -> float:
    return stretch[0]


def sharpness_of(image: Image) -> float:
    """How much finer detail there is than coarse: how sharply edges bend at full size over that at a quarter of it.

    Along x or y, whichever is less, as motion blurs one direction. A lens in focus gives 0.3 and more.
    """
    import cv2

    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    smooth = [cv2.GaussianBlur(size, (0, 0), 0.8) for size in (image, small)]
    ratios = []
    for order in ((2, 0), (0, 2)):
        bends = (cv2.Sobel(i, cv2.CV_16S, *order) for i in smooth)
        # At the same places of both: to look everywhere takes ten times as long and tells no more.
        fine, coarse = (_sharpest(bend[::step, ::step]) for bend, step in zip(bends, (4, 1), strict=True))
        ratios.append(fine / max(coarse, _LEAST_BEND))
    return min(ratios)


def _sharpest(bend: ArrayLike) -> float:
    """The size that one in a hundred exceeds."""
    sizes = np.abs(bend).ravel()
    place = int(0.99 * (len(sizes) - 1))
    return float(np.partition(sizes, place)[place])


def _look(image: Image) -> tuple[float, float, float, float]:
    some = image[::4, ::4]
    return float(some.mean()), float(some.std()), float((some >= _SATURATED).mean()), sharpness_of(image)


class _Corners:
    """The plainest detector, so that a look at a recording depends on no plug-in."""

    def detect(self, image: Image, max_points: int) -> Keypoints:
        import cv2

        found = cv2.goodFeaturesToTrack(image, max_points, 0.01, 8.0)
        xy = np.empty((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)
        return Keypoints(xy, np.arange(len(xy), 0, -1, dtype=np.float32))


def _followed(frames: list[FrameSet], calibration: Calibration) -> tuple[FrameTracks, ...]:
    """The tracks through consecutive ``frames``, by images alone: no calibration has a say in what is an outlier."""
    blind = calibration.with_camera(0, rotation_known=False)
    options = FrontendOptions(max_points=_POINTS, rejection="none")
    frontend = Frontend(_Corners(), blind, options, Incidents())
    nothing = ImuSegment(np.zeros(1, np.int64), np.zeros((1, 3)), np.zeros((1, 3)))
    return tuple(frontend.track(nothing, each, blind) for each in frames)
