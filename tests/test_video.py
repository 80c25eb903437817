"""Videos with their IMU within: what a GoPro would have written of a rendered flight."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from gopro_helpers import add_telemetry, write_video
from rendered_flight import CALIBRATION, FRAME_RATE_HZ, rendered_flight

from vioframe.cli import main
from vioframe.errors import CalibrationError, DatasetError, ImageSizeError, PluginError
from vioframe.evaluation import evaluate
from vioframe.io.calibration import sidecar_folder, write_calibration
from vioframe.parts import registry
from vioframe.runs.folder import RunFolder
from vioframe.testing import check_dataset
from vioframe.types import FrameSet, ImuSample, Unreadable
from vioframe_video import VideoDataset

pytest.importorskip("telemetry_parser")

WIDTH, HEIGHT = CALIBRATION.cameras[0].model.resolution


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight, beginning with its first image, and its calibration where it is looked for."""
    path = tmp_path_factory.mktemp("gopro") / "GX010001.MP4"
    flight = rendered_flight().measurements
    write_video(path, [m.images[0] for m in flight if isinstance(m, FrameSet)], FRAME_RATE_HZ)
    readings = [m for m in flight if isinstance(m, ImuSample)]
    add_telemetry(path, np.array([m.gyro_B for m in readings]), np.array([m.accel_B for m in readings]), 200.0)
    write_calibration(CALIBRATION, sidecar_folder(path))
    return path


def test_readings_and_images_are_those_of_the_flight(video: Path):
    flown = rendered_flight().measurements
    brought = list(VideoDataset(video).measurements())
    assert not [m for m in brought if isinstance(m, Unreadable)]
    for kind in (ImuSample, FrameSet):
        given, got = ([m for m in all_of if isinstance(m, kind)] for all_of in (flown, brought))
        assert [m.t_ns - given[0].t_ns for m in given] == [m.t_ns for m in got]
        for one, other in zip(given, got, strict=True):
            if isinstance(one, ImuSample):
                np.testing.assert_allclose(other.gyro_B, one.gyro_B, atol=0.51 / 939)
                np.testing.assert_allclose(other.accel_B, one.accel_B, atol=0.51 / 417)
            else:
                assert np.abs(other.images[0].astype(int) - one.images[0]).mean() < 4.0  # the video is compressed
    stamps = [m.t_ns for m in brought]
    assert stamps == sorted(stamps)


def test_it_conforms(video: Path):
    check_dataset(VideoDataset, video)


def test_fewer_and_smaller_images_have_a_calibration_of_their_own(video: Path):
    whole, part = VideoDataset(video), VideoDataset(video, every=3, shrink=2)
    assert part.calibration.cameras[0].model == whole.calibration.cameras[0].model.shrunk(2)
    expected = [m for m in whole.measurements() if isinstance(m, FrameSet)][::3]
    got = [m for m in part.measurements() if isinstance(m, FrameSet)]
    assert part.frame_count == len(got)
    assert [m.t_ns for m in got] == [m.t_ns for m in expected]
    blocks = expected[5].images[0][: HEIGHT // 2 * 2, : WIDTH // 2 * 2].reshape(HEIGHT // 2, 2, WIDTH // 2, 2)
    np.testing.assert_allclose(got[5].images[0], blocks.mean(axis=(1, 3)), atol=0.51)


@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["", "video:"])
def test_it_flies(video: Path, tmp_path: Path, prefix: str):
    said = CliRunner().invoke(main, ["run", f"{prefix}{video}", "--out", str(tmp_path / "run"), "--quiet"])
    assert said.exit_code == 0, said.output
    run = RunFolder.open(tmp_path / "run")
    assert run.summary["completion"] > 0.95
    estimate, truth = run.trajectory(), rendered_flight().ground_truth
    assert estimate is not None
    first_ns = rendered_flight().measurements[0].t_ns
    flown = replace(truth, t_ns=truth.t_ns - first_ns)
    assert evaluate(estimate, flown).ate_m.rmse < 0.1


def test_a_video_without_readings_is_refused(video: Path, tmp_path: Path):
    plain = tmp_path / "plain.mp4"
    write_video(plain, [np.full((HEIGHT, WIDTH), 90, np.uint8)] * 5, FRAME_RATE_HZ)
    said = CliRunner().invoke(main, ["run", f"video:{plain}"])
    assert said.exit_code == 2
    assert said.output.count("\n") == 1
    assert "has no readings of an IMU in it (Unsupported file format); take a video of a camera that" in said.output


def test_what_is_no_video_is_refused(tmp_path: Path):
    notes = tmp_path / "notes.mp4"
    notes.write_text("not a video")
    with pytest.raises(DatasetError, match="no readings of an IMU"):
        VideoDataset(notes)
    with pytest.raises(DatasetError, match=r"missing\.mp4 does not exist"):
        registry.load().open_dataset(f"video:{tmp_path / 'missing.mp4'}")
    with pytest.raises(DatasetError, match="no recording named: video:FILE"):
        registry.load().open_dataset("video:")


def test_whatever_the_parser_raises_is_told(video: Path, monkeypatch: pytest.MonkeyPatch):
    class Panic(BaseException):
        """As those of Rust are."""

    def panics(path: str) -> None:
        raise Panic("index out of bounds")

    monkeypatch.setattr("telemetry_parser.Parser", panics)
    with pytest.raises(DatasetError, match=r"no readings of an IMU in it \(index out of bounds\)"):
        VideoDataset(video)


def test_a_video_that_ends_early_is_told(video: Path, monkeypatch: pytest.MonkeyPatch):
    class Cut:  # not a subclass, with which OpenCV crashes when it is collected
        def __init__(self, *arguments: Any) -> None:
            self._whole, self._left = whole(*arguments), 40

        def grab(self) -> bool:
            self._left -= 1
            return self._left >= 0 and self._whole.grab()

        def __getattr__(self, name: str) -> Any:
            return getattr(self._whole, name)

    whole = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", Cut)
    images = [m for m in VideoDataset(video).measurements() if not isinstance(m, ImuSample)]
    assert len(images) == 41
    assert images[-1] == Unreadable(images[-2].t_ns, "frame_unreadable", "the video ends after 40 of 116 images")


def test_a_calibration_that_does_not_fit_is_refused(video: Path, tmp_path: Path):
    small = CALIBRATION.with_camera(0, model=CALIBRATION.cameras[0].model.shrunk(2))
    write_calibration(small, tmp_path / "small")
    with pytest.raises(ImageSizeError, match=f"images of {WIDTH}x{HEIGHT}, but the calibration is for"):
        list(VideoDataset(video, calibration=tmp_path / "small").measurements())
    alone = tmp_path / "alone.mp4"
    alone.write_bytes(video.read_bytes())
    with pytest.raises(DatasetError, match=r"brings no calibration: --calibration FILE names one, and .*alone\.mp4\.c"):
        VideoDataset(alone)
    with pytest.raises(CalibrationError, match="describes no camera 'cam7'"):
        VideoDataset(video, cameras="cam7")


def test_without_the_library_it_is_told_how_to_get_it(video: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "telemetry_parser", None)
    with pytest.raises(PluginError, match=r"reader 'video' needs telemetry_parser.*'vioframe\[video\]'"):
        VideoDataset(video)
