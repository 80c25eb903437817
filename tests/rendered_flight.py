"""A short flight with pictures: dots on the walls of a room, small and quick to render, real enough to be tracked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from vioframe.geometry.cameras import Camera
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.io.convert import convert
from vioframe.io.trajectories import write_tum
from vioframe.simulation.flights import flight
from vioframe.simulation.imu import read_imu
from vioframe.types import NS_PER_S, Calibration, FrameSet, ImuSample, Measurement

WIDTH, HEIGHT = 376, 240
FRAME_RATE_HZ = 10
DURATION_S = 11.5
# EuRoC's camera, without its distortion, at half its resolution.
CALIBRATION: Calibration = packaged_calibration("euroc", cameras=["cam0"]).with_camera(
    0, model=Camera(229.0, 229.0, 187.5, 119.5, (0.0, 0.0, 0.0, 0.0), (WIDTH, HEIGHT))
)
CAMERA = CALIBRATION.cameras[0]
# The flight "stop_and_go" begins with 4 s of rest, more than initialisation needs.
_BEGIN_S = 2.5
_START_NS = 100 * NS_PER_S
_DOTS, _WALL_M = 2400, 6.0
_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class RenderedFlight:
    """``measurements`` in order of time, and where the body was at each frame."""

    measurements: list[Measurement]
    ground_truth: Trajectory

    def write(self, path: Path, measurements: list[Measurement] | None = None) -> Path:
        """A recording in the format that ``path`` tells, its calibration with it; by default of this very flight."""
        convert(self.measurements if measurements is None else measurements, CALIBRATION, path)
        return path

    def write_ground_truth(self, path: Path) -> Path:
        write_tum(self.ground_truth, path)
        return path


@cache
def rendered_flight() -> RenderedFlight:
    """1.5 s at rest, 8 s of flight, 2 s at rest: 10 images and 200 readings a second, with the noise of EuRoC's IMU."""
    rng = np.random.default_rng(0)
    path = flight("stop_and_go", _BEGIN_S + DURATION_S + 1.0, CAMERA.R_BC)
    frames_s = np.arange(round(DURATION_S * FRAME_RATE_HZ) + 1) / FRAME_RATE_HZ
    # Readings go on beyond the last frame, as in a recording.
    imu_s = np.arange(round(DURATION_S * 200) + 21) / 200
    readings = read_imu(path.at(_BEGIN_S + imu_s), CALIBRATION.imu, rng, 200.0)
    motion = path.at(_BEGIN_S + frames_s)
    p_WF = rng.uniform(-_WALL_M, _WALL_M, (_DOTS, 3))
    wall = rng.integers(0, 3, _DOTS)
    p_WF[np.arange(_DOTS), wall] = _WALL_M * rng.choice([-1.0, 1.0], _DOTS)
    looks = np.column_stack([rng.uniform(1.5, 4.0, _DOTS), rng.integers(0, 256, _DOTS)])

    imu_ns, frames_ns = ((_START_NS + np.round(t * NS_PER_S)).astype(np.int64) for t in (imu_s, frames_s))
    samples = zip(imu_ns.tolist(), readings.gyro_B, readings.accel_B, strict=True)
    measurements: list[Measurement] = [ImuSample(*sample) for sample in samples]
    for t_ns, R_WB, p_WB in zip(frames_ns.tolist(), motion.R_WB, motion.p_WB, strict=True):
        image = _render(R_WB @ CAMERA.R_BC, R_WB @ CAMERA.p_BC + p_WB, p_WF, looks)
        measurements.append(FrameSet(t_ns, (image,)))
    measurements.sort(key=lambda m: m.t_ns)
    return RenderedFlight(measurements, Trajectory(frames_ns, motion.R_WB, motion.p_WB))


def _render(R_WC: np.ndarray, p_WC: np.ndarray, p_WF: np.ndarray, looks: np.ndarray) -> np.ndarray:
    """(H, W) uint8: each dot a disc of its own radius (px) and grey level, drawn to a sixteenth of a pixel."""
    p_CF = (p_WF - p_WC) @ R_WC
    ahead = p_CF[:, 2] > 0.3
    xy = CAMERA.model.project(p_CF[ahead])
    near = CAMERA.model.contains(xy, -10.0)
    image = np.full((HEIGHT, WIDTH), 120, np.uint8)
    scale = 1 << _SUBPIXEL_BITS
    for (x, y), (radius, grey) in zip(np.round(xy[near] * scale).astype(int), looks[ahead][near], strict=True):
        cv2.circle(image, (int(x), int(y)), int(radius * scale), int(grey), -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    image.flags.writeable = False
    return image
