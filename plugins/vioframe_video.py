"""Videos with their IMU within, as action cameras write them: pictures by OpenCV, readings by telemetry-parser."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vioframe.errors import DatasetError, needs, shortened
from vioframe.interfaces import DatasetFactory
from vioframe.io.calibration import match_cameras, no_calibration, sidecar_folder
from vioframe.io.images import check_size, to_gray8
from vioframe.parts.hooks import hookimpl
from vioframe.types import FrameSet, Image, ImuSample, Measurement, Unreadable

_SUFFIXES = (".mp4", ".mov", ".insv", ".lrv", ".360")
_NS_PER_MS = 1_000_000


class VideoDataset:
    """A video and the readings that are in it; time counts from its beginning.

    B has the axes that telemetry-parser gives: of a GoPro those of its first model, whichever model it is.
    """

    ground_truth = None

    def __init__(
        self,
        path: Path,
        *,
        cameras: Annotated[list[str] | str | None, "the camera, where the calibration is of several"] = None,
        calibration: Annotated[list[Path] | Path | None, "calibration files or folder, for the images in full"] = None,
        every: Annotated[int, Field(ge=1, description="take every so many images")] = 1,
        shrink: Annotated[int, Field(ge=1, le=16, description="make one pixel of so many by so many")] = 1,
    ) -> None:
        self._path, self._every, self._shrink = path, every, shrink
        self._readings = _readings(path)
        files = [calibration] if isinstance(calibration, Path) else calibration
        if not files:
            files = [sidecar_folder(path)]
            if not files[0].is_dir():
                raise no_calibration(path, files[0])
        rig, _ = match_cameras(files, [path.name], [cameras] if isinstance(cameras, str) else cameras)
        if len(rig.cameras) > 1:
            raise DatasetError(f"{path} is of one camera; choose which calibration is its own with --cameras")
        self._full = rig.cameras[0].model
        self.calibration = rig.with_camera(0, model=self._full.shrunk(shrink))

    @staticmethod
    def accepts(path: Path) -> bool:
        """Whether ``path`` is named like a video."""
        return path.is_file() and path.suffix.lower() in _SUFFIXES

    @property
    def name(self) -> str:
        return self._path.stem

    @property
    def frame_count(self) -> int:
        import cv2

        return -(-int(_opened(self._path).get(cv2.CAP_PROP_FRAME_COUNT)) // self._every)

    def measurements(self) -> Iterator[Measurement]:
        """In the order of their stamps."""
        return merge(self._readings, self._images(), key=lambda measurement: measurement.t_ns)

    def _images(self) -> Iterator[FrameSet | Unreadable]:
        import cv2

        video = _opened(self._path)
        # As the sensor saw it, which is what is calibrated: not turned upright.
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0.0)
        number, t_ns = 0, 0
        while video.grab():
            t_ns = round(video.get(cv2.CAP_PROP_POS_MSEC) * _NS_PER_MS)
            if number % self._every == 0:
                there, image = video.retrieve()
                if there:
                    yield FrameSet(t_ns, (self._gray(image),))
                else:
                    yield Unreadable(t_ns, "frame_unreadable", "the image is damaged")
            number += 1
        promised = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        if number < promised:
            yield Unreadable(t_ns, "frame_unreadable", f"the video ends after {number} of {promised} images")

    def _gray(self, image: Any) -> Image:
        import cv2

        gray = to_gray8(image, None, str(self._path))
        check_size(gray, self._full, str(self._path))
        if self._shrink == 1:
            return gray
        width, height = self.calibration.cameras[0].model.resolution
        whole = gray[: height * self._shrink, : width * self._shrink]
        small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
        small.flags.writeable = False
        return small


def _opened(path: Path) -> Any:
    """The pictures of a video, to be read one after the other; raises :class:`DatasetError` where there are none."""
    import cv2

    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise DatasetError(f"{path} has no pictures that can be decoded; copy it from the camera again")
    return video


def _readings(path: Path) -> Sequence[ImuSample]:
    """What gyroscope and accelerometer read, in the order of time; raises :class:`DatasetError` where there is none."""
    with needs("telemetry_parser", "video", user="reader 'video'"):
        telemetry = import_module("telemetry_parser")  # it brings no types
    try:
        parser = telemetry.Parser(str(path))
        rows = [row for row in parser.normalized_imu() if row["gyro"] is not None and row["accl"] is not None]
    except BaseException as error:  # a damaged file has it raise anything, and panic, which is no Exception
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise _none(path, shortened(error)) from error
    if not rows:
        raise _none(path, f"the telemetry of this {parser.camera} is of other kinds")
    t_ns = np.round(np.array([row["timestamp_ms"] for row in rows]) * _NS_PER_MS).astype(np.int64)
    gyro_B = np.radians(np.array([row["gyro"] for row in rows]))
    accel_B = np.array([row["accl"] for row in rows], np.float64)
    order = np.argsort(t_ns, kind="stable")
    return [ImuSample(int(t_ns[i]), gyro_B[i], accel_B[i]) for i in order]


def _none(path: Path, why: str) -> DatasetError:
    return DatasetError(
        f"{path} has no readings of an IMU in it ({why}); take a video of a camera that keeps them, as GoPro's HERO5 "
        "and later do, as it came from the camera: cutting and converting loses them"
    )


@hookimpl
def vioframe_datasets() -> Mapping[str, DatasetFactory]:
    return {"video": VideoDataset}
