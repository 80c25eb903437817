"""Checks a data-set reader on a recording that its author provides."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Dataset, DatasetFactory
from vioframe.testing.require import fail, require
from vioframe.types import NS_PER_S, Calibration, FrameSet, ImuSample

_MAX_DISORDER_NS = NS_PER_S


def check_dataset(factory: DatasetFactory, path: Path, *, max_frames: int = 50, **options: Any) -> None:
    """Check ``factory(path, **options)`` against :class:`vioframe.interfaces.Dataset`, on the first ``max_frames``.

    ``path`` is accepted and a file of something else is not; what is missing raises DatasetError. A frame set has a
    place for each calibrated camera and at least one image; images are (H, W) uint8, read-only and of the size that
    their camera is calibrated for. Stamps are integer nanoseconds and no more than a second out of order.
    """
    path = Path(path)
    require(factory.accepts(path) is True, f"accepts({path.name}) is not True")
    with TemporaryDirectory() as folder:
        stranger = Path(folder) / "notes.txt"
        stranger.write_text("not a recording\n")
        require(factory.accepts(stranger) is False, "accepts() does not refuse a text file")
        _check_refuses(factory, Path(folder) / "missing", options)
    dataset = factory(path, **options)
    check_about(dataset)
    check_measurements(dataset, max_frames)


def check_about(dataset: Dataset) -> None:
    """What a data set says of itself."""
    require(isinstance(dataset.name, str) and dataset.name, f"name is {dataset.name!r}, expected a short string")
    require(isinstance(dataset.calibration, Calibration), f"calibration is a {type(dataset.calibration).__name__}")
    require(dataset.ground_truth is None or isinstance(dataset.ground_truth, Trajectory), "ground_truth: no Trajectory")


def _check_refuses(factory: DatasetFactory, missing: Path, options: dict[str, Any]) -> None:
    try:
        list(factory(missing, **options).measurements())
    except DatasetError:
        return
    except Exception as error:
        fail(f"a path that does not exist raised {error!r}, expected a DatasetError")
    fail("a path that does not exist raised nothing, expected a DatasetError")


def check_measurements(dataset: Dataset, max_frames: int) -> None:
    """What it brings, up to so many frames."""
    latest: dict[type, int] = {}
    counts: Counter[type] = Counter()
    for measurement in dataset.measurements():
        kind = type(measurement)
        if not isinstance(measurement, FrameSet | ImuSample):
            continue  # a note of something irregular
        require(isinstance(measurement.t_ns, int), f"t_ns of a {kind.__name__} is a {type(measurement.t_ns).__name__}")
        if isinstance(measurement, FrameSet):
            _check_frames(measurement, dataset.calibration)
        else:
            require(measurement.gyro_B.shape == measurement.accel_B.shape == (3,), "gyro_B and accel_B must be (3,)")
        behind_ns = max(latest.values(), default=measurement.t_ns) - measurement.t_ns
        require(behind_ns <= _MAX_DISORDER_NS, f"a {kind.__name__} comes {behind_ns / NS_PER_S:.1f} s too late")
        latest[kind] = measurement.t_ns
        counts[kind] += 1
        if counts[FrameSet] >= max_frames:
            break
    require(
        counts[FrameSet] and counts[ImuSample], f"{counts[FrameSet]} frames and {counts[ImuSample]} IMU samples came"
    )
    require(
        dataset.frame_count is None or dataset.frame_count >= counts[FrameSet],
        f"frame_count is {dataset.frame_count}, but {counts[FrameSet]} frames came",
    )


def _check_frames(frames: FrameSet, calibration: Calibration) -> None:
    cameras, images = calibration.cameras, frames.images
    require(isinstance(images, tuple), f"the images of a frame set are a {type(images).__name__}, not a tuple")
    counts = f"{len(images)} places, the calibration {len(cameras)} cameras"
    require(len(images) == len(cameras), f"a frame set has {counts}")
    require(any(image is not None for image in images), "a frame set holds no image")
    for image, camera in zip(images, cameras, strict=True):
        if image is None:
            continue
        require(
            image.ndim == 2 and image.dtype == np.uint8, f"an image of {camera.name} is {image.shape} {image.dtype}"
        )
        require(
            image.shape[::-1] == camera.model.resolution,
            f"an image of {camera.name} is {image.shape[::-1]}, the calibration for {camera.model.resolution}",
        )
        require(not image.flags.writeable, f"an image of {camera.name} is writeable")
