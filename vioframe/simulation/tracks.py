"""Feature tracks without images: static landmarks seen from a known motion, with noise in the pixels and nowhere else.

A :class:`TrackSequence` is a recording reduced to what a back-end takes in, with the truth that it is judged by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.errors import ConfigError, DatasetError
from vioframe.geometry.cameras import Camera
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.interfaces import Flight
from vioframe.io.calibration import packaged_calibration
from vioframe.io.synchronise import synchronise
from vioframe.simulation.felt import felt
from vioframe.simulation.flights import flight as named_flight
from vioframe.simulation.imu import ImuErrors
from vioframe.simulation.scenario import Scenario, fly, load_euroc
from vioframe.types import (
    NS_PER_S,
    Calibration,
    FrameSet,
    FrameTracks,
    ImuNoise,
    ImuSample,
    ImuSegment,
    Measurement,
    NavState,
)

Packet = tuple[ImuSegment, FrameTracks]
PoseLater = Callable[[int, Float], tuple[Float, Float]]
"""The camera's place in the rig, and seconds (N,) after the frame's stamp: ``R_WB`` (N, 3, 3), ``p_WB`` (N, 3) m."""

REAL_MOTION_SEQUENCES = ("MH_02_easy", "MH_03_medium", "MH_05_difficult", "V1_01_easy", "V1_02_medium")
"""The flights of ``euroc_imu_gt`` in the shared data."""

EUROC_NOISE = ImuNoise(
    gyro_density=1.6968e-4, accel_density=2.0e-3, gyro_walk=1.9393e-5, accel_walk=3.0e-3, rate_hz=200.0
)
"""That of the ADIS16448 in EuRoC's sensor, as published."""

_DURATION_S = 30.0
# Landmarks nearer than this cannot be tracked: they cross the image too fast.
_NEAREST_M = 0.3
# Landmarks are seen this far inside the image, as a tracking window needs.
_BORDER_PX = 5.0
_OUTLIER_PX = (5.0, 30.0)
# The row of a rolling shutter that sees a landmark is found to this.
_ROW_STEP_PX, _MOST_ROW_STEPS = 1e-6, 20


@dataclass(frozen=True)
class TrackSequence:
    """Packets for :meth:`vioframe.interfaces.Backend.process`, one a frame, and the motion behind them.

    ``ground_truth`` holds a pose for each frame. ``true_states``, where they are known, hold velocity and biases too
    (one a frame, or none at all).
    """

    name: str
    calibration: Calibration
    packets: tuple[Packet, ...]
    ground_truth: Trajectory
    true_states: tuple[NavState, ...] = ()

    def measurements(self) -> Iterator[ImuSample | FrameTracks]:
        """The readings, with stamps of the IMU's clock, and the frames: each behind those up to its stamp."""
        offset_ns = self.calibration.cameras[0].time_offset_ns
        for k, (imu, tracks) in enumerate(self.packets):
            new = slice(1 if k else 0, None)
            yield from map(ImuSample, (imu.t_ns[new] + offset_ns).tolist(), imu.gyro_B[new], imu.accel_B[new])
            yield tracks


@dataclass(frozen=True)
class TrackOptions:
    """What the simulated front-end sees. Landmarks are born at a depth drawn uniformly from ``depth_m``."""

    max_points: int = 150
    """Landmarks are born in a camera until it sees so many."""
    pixel_sigma: float = 1.0
    """Standard deviation of an observation, px on either axis of the raw (distorted) image."""
    outlier_ratio: float = 0.0
    """Chance that an observation is off by 5 to 30 px."""
    depth_m: tuple[float, float] = (2.0, 10.0)


def simulated_sequence(
    flight: str | Flight,
    noise: ImuNoise | None = EUROC_NOISE,
    pixel_sigma: float = 1.0,
    seed: int = 0,
    duration_s: float | None = None,
    *,
    outlier_ratio: float = 0.0,
    max_points: int = 150,
    calibration: Calibration | None = None,
    frame_rate_hz: float = 20.0,
    bias_gyro_B: Float | None = None,
    bias_accel_B: Float | None = None,
) -> TrackSequence:
    """Fly ``flight``, an installed one of that name or one's own, for ``duration_s`` seconds.

    Left out, that is 30 s, or as long as one's own flight lasts. ``noise`` None gives exact readings at the
    calibration's rate, and ``calibration`` None is EuRoC's. The first biases (3,) are zero unless given. The same
    arguments give the same sequence to the last bit. Readings at the frames' stamps are interpolated as those of a
    recording would be, unless the frame rate divides the IMU's.
    """
    calibration = calibration or packaged_calibration("euroc", cameras=["cam0"])
    imu_rng, track_rng = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2))
    rate_hz = (noise or calibration.imu).rate_hz
    path, duration_s = _path(flight, duration_s, calibration)
    frames_s = np.arange(int(duration_s * frame_rate_hz) + 1) / frame_rate_hz
    scenario = fly(
        path,
        flight if isinstance(flight, str) else type(flight).__name__,
        imu_rng,
        frames_s=frames_s,
        imu_s=np.arange(int(np.ceil(frames_s[-1] * rate_hz)) + 1) / rate_hz,
        imu_rate_hz=rate_hz,
        noise=noise,
        errors=_starting_at(bias_gyro_B, bias_accel_B),
    )
    options = TrackOptions(max_points, pixel_sigma, outlier_ratio)
    return _sequence(scenario, calibration, TrackSimulator(calibration, options, track_rng))


def real_motion_sequence(
    folder: Path,
    calibration: Calibration | None = None,
    *,
    pixel_sigma: float = 1.0,
    max_points: int = 150,
    seed: int = 0,
    start_s: float = 0.0,
    duration_s: float | None = None,
) -> TrackSequence:
    """Landmarks seen at its camera's stamps along the path that the IMU of ``folder`` :func:`felt`, and what it read.

    ``folder``, ``start_s`` and ``duration_s`` are those of :func:`~vioframe.simulation.scenario.load_euroc`.
    ``calibration`` is EuRoC's as published unless given.
    """
    calibration = calibration or packaged_calibration("euroc", cameras=["cam0"])
    scenario = felt(load_euroc(folder, start_s=start_s, duration_s=duration_s), calibration.imu)
    options = TrackOptions(max_points, pixel_sigma)
    return _sequence(scenario, calibration, TrackSimulator(calibration, options, np.random.default_rng(seed)))


def simulated_stream(
    flight: str | Flight,
    noise: ImuNoise | None = EUROC_NOISE,
    options: TrackOptions | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    *,
    calibration: Calibration | None = None,
    frame_rate_hz: float = 20.0,
    piece_s: float = 10.0,
) -> Iterator[ImuSample | FrameTracks]:
    """As :func:`simulated_sequence`, but made as it is taken, in pieces of ``piece_s`` seconds: for flights of hours.

    Readings, with stamps of the IMU's clock, and frames come in the order of their stamps. The noise is not that of the
    sequence with the same seed.
    """
    calibration = calibration or packaged_calibration("euroc", cameras=["cam0"])
    imu_rng, track_rng = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2))
    simulator = TrackSimulator(calibration, options or TrackOptions(), track_rng)
    rate_hz = (noise or calibration.imu).rate_hz
    path, duration_s = _path(flight, duration_s, calibration)
    readings, frames = (np.arange(int(duration_s * hz + 1e-9) + 1) / hz for hz in (rate_hz, frame_rate_hz))
    errors = ImuErrors()
    for begin_s in np.arange(0.0, duration_s, piece_s).tolist():
        end_s = begin_s + piece_s if begin_s + piece_s < duration_s else np.inf
        # A piece begins with the last reading of the one before, whose biases it goes on from.
        first, last = np.searchsorted(readings, [begin_s, end_s])
        imu_s = readings[max(first - 1, 0) : last]
        frames_s = frames[(frames >= begin_s) & (frames < end_s)]
        piece = fly(
            path,
            "",
            imu_rng,
            frames_s=frames_s,
            imu_s=imu_s,
            imu_rate_hz=rate_hz,
            noise=noise,
            errors=errors,
            time_offset_ns=calibration.cameras[0].time_offset_ns,
        )
        errors = _starting_at(*np.split(piece.truth.values[-1, 10:], 2))
        new = slice(1 if first else 0, None)
        samples = map(ImuSample, piece.imu_ns[new].tolist(), piece.gyro_B[new], piece.accel_B[new])
        measured: Iterable[ImuSample | FrameTracks] = samples
        yield from merge(measured, _tracks(piece, calibration, simulator), key=lambda item: item.t_ns)


class TrackSimulator:
    """Tracks landmarks frame by frame: one lives while a camera sees it and is never seen again after that.

    As in the simulator of OpenVINS (Geneva et al., ICRA 2020), a new landmark is put at a random pixel and a random
    depth whenever there are fewer than wanted. One that lies in the view of several cameras has the same id in all.
    ``p_WF`` maps the ids that live to their true positions, (3,) m.
    """

    def __init__(self, calibration: Calibration, options: TrackOptions, rng: np.random.Generator) -> None:
        self._cameras = calibration.cameras
        self._options = options
        self._rng = rng
        self._widest = [_widest_radius(camera.model) for camera in calibration.cameras]
        self._ids: Int = np.empty(0, np.int64)
        self._p_WF: Float = np.empty((0, 3))
        self._next_id = 0

    @property
    def p_WF(self) -> dict[int, Float]:
        return dict(zip(self._ids.tolist(), self._p_WF, strict=True))

    def observe(self, t_ns: int, R_WB: Float, p_WB: Float, later: PoseLater | None = None) -> FrameTracks:
        """The tracks of frames taken at ``R_WB`` (3, 3), ``p_WB`` (3,) m.

        Where cameras have clocks of their own, the poses are one a camera: (C, 3, 3) and (C, 3). A camera with a
        rolling shutter needs to know where the body is ``later`` than that: each point is seen from the pose at the
        time of its own row.
        """
        count = len(self._cameras)
        R_WB, p_WB = np.broadcast_to(R_WB, (count, 3, 3)), np.broadcast_to(p_WB, (count, 3))
        poses = [camera.pose(R, p) for camera, R, p in zip(self._cameras, R_WB, p_WB, strict=True)]
        views = [self._project(c, *pose, later, self._p_WF) for c, pose in enumerate(poses)]
        living = np.any([seen for _, seen in views], axis=0)
        self._ids, self._p_WF = self._ids[living], self._p_WF[living]
        views = [(xy[living], seen[living]) for xy, seen in views]
        for c in range(count):
            missing = self._options.max_points - int(views[c][1].sum())
            if missing > 0:
                born_xy, p_WF = self._add_landmarks(c, missing, *poses[c], later)
                for other, (xy, seen) in enumerate(views):
                    new_xy, new_seen = self._project(other, *poses[other], later, p_WF)
                    if other == c:  # the very pixels that were drawn
                        new_xy, new_seen = born_xy, np.ones(missing, bool)
                    views[other] = np.concatenate([xy, new_xy]), np.concatenate([seen, new_seen])
        parts = []
        for c, (ideal_xy, seen) in enumerate(views):
            xy = self._disturb(ideal_xy[seen])
            parts.append((self._ids[seen], np.full(len(xy), c), xy, self._cameras[c].model.undistort(xy)))
        ids, camera, xy, xy_normalised = map(np.concatenate, zip(*parts, strict=True))
        return FrameTracks(t_ns, ids, camera, xy, xy_normalised)

    def _project(
        self, camera: int, R_WC: Float, p_WC: Float, later: PoseLater | None, p_WF: Float
    ) -> tuple[Float, Bool]:
        """Pixels (N, 2) of landmarks (N, 3) m in a camera, and which of them it sees."""
        xy, seen = self._project_from(camera, R_WC, p_WC, p_WF)
        if not self._cameras[camera].readout_s or not len(p_WF):
            return xy, seen
        height = self._cameras[camera].model.resolution[1]
        for _ in range(_MOST_ROW_STEPS):
            # What is out of sight is looked for from the nearest row, and behind the camera from the middle one.
            y = np.nan_to_num(np.clip(xy[:, 1], 0.0, height - 1.0), nan=0.5 * (height - 1.0))
            xy, seen = self._project_from(camera, *self._row_poses(camera, y, later), p_WF)
            if not seen.any() or np.abs(xy[seen, 1] - y[seen]).max() < _ROW_STEP_PX:
                break
        return xy, seen

    def _row_poses(self, camera: int, y: Float, later: PoseLater | None) -> tuple[Float, Float]:
        """Of a camera when it exposes its rows ``y`` (N,): R_WC (N, 3, 3) and p_WC (N, 3)."""
        on_body = self._cameras[camera]
        if later is None:
            raise ConfigError(f"{on_body.name} has a rolling shutter: say where the body is at the time of a row")
        return on_body.pose(*later(camera, on_body.readout_s * on_body.row(y)))

    def _project_from(self, camera: int, R_WC: Float, p_WC: Float, p_WF: Float) -> tuple[Float, Bool]:
        """The same from one pose, or from one for each landmark."""
        model = self._cameras[camera].model
        p_CF = (p_WF - p_WC) @ R_WC if R_WC.ndim == 2 else np.einsum("ni,nij->nj", p_WF - p_WC, R_WC)
        in_front = p_CF[:, 2] > _NEAREST_M
        uv = p_CF[:, :2] / np.where(in_front, p_CF[:, 2], 1.0)[:, None]
        # Far outside the image the distortion model folds back into it.
        in_front &= (uv * uv).sum(axis=1) < self._widest[camera] ** 2
        xy = np.full_like(uv, np.nan)
        xy[in_front] = model.distort(uv[in_front])
        return xy, in_front & model.contains(xy, _BORDER_PX)

    def _add_landmarks(
        self, camera: int, count: int, R_WC: Float, p_WC: Float, later: PoseLater | None
    ) -> tuple[Float, Float]:
        """Pixels (N, 2) and positions (N, 3) m of ``count`` new ones, anywhere in the view of a camera."""
        model = self._cameras[camera].model
        xy = self._rng.uniform(_BORDER_PX, np.array(model.resolution) - 1.0 - _BORDER_PX, (count, 2))
        depth = self._rng.uniform(*self._options.depth_m, count)
        rays_C = np.column_stack([model.undistort(xy), np.ones(count)])
        p_CF = rays_C * depth[:, None]
        if self._cameras[camera].readout_s:
            R_WC, p_WC = self._row_poses(camera, xy[:, 1], later)
            p_WF = np.einsum("nij,nj->ni", R_WC, p_CF) + p_WC
        else:
            p_WF = p_CF @ R_WC.T + p_WC
        self._ids = np.concatenate([self._ids, np.arange(self._next_id, self._next_id + count)])
        self._next_id += count
        self._p_WF = np.concatenate([self._p_WF, p_WF])
        return xy, p_WF

    def _disturb(self, xy: Float) -> Float:
        xy = xy + self._rng.normal(0.0, self._options.pixel_sigma, xy.shape)
        wrong = self._rng.random(len(xy)) < self._options.outlier_ratio
        angle = self._rng.uniform(0.0, 2.0 * np.pi, wrong.sum())
        length = self._rng.uniform(*_OUTLIER_PX, wrong.sum())
        xy[wrong] += length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return xy


def cut_segments(t_ns: Int, gyro_B: Float, accel_B: Float, frames_ns: Int) -> list[ImuSegment]:
    """One segment a frame, as :func:`vioframe.io.synchronise.synchronise` cuts them.

    ``t_ns`` (N,) ascending, ``gyro_B`` (N, 3) rad/s, ``accel_B`` (N, 3) m/s^2, ``frames_ns`` (M,) ascending and within
    the readings; raises :class:`DatasetError` where that is not so and a frame would be left without its segment.
    """
    samples: Iterable[Measurement] = map(ImuSample, t_ns.tolist(), gyro_B, accel_B)
    frames: Iterable[Measurement] = (FrameSet(t, ()) for t in frames_ns.tolist())
    incidents = Incidents()
    stream = merge(samples, frames, key=lambda measurement: measurement.t_ns)
    segments = [segment for segment, _ in synchronise(stream, incidents=incidents)]
    if len(segments) != len(frames_ns):
        raise DatasetError(f"frames lie outside the inertial readings or repeat: {dict(incidents.counts)}")
    return segments


def _sequence(scenario: Scenario, calibration: Calibration, simulator: TrackSimulator) -> TrackSequence:
    frames_ns = scenario.frames_ns
    segments = cut_segments(scenario.imu_ns, scenario.gyro_B, scenario.accel_B, frames_ns)
    R_WB, p_WB, _ = scenario.motion(frames_ns)
    packets = zip(segments, _tracks(scenario, calibration, simulator), strict=True)
    truth = Trajectory(frames_ns, R_WB, p_WB)
    return TrackSequence(scenario.name, calibration, tuple(packets), truth, scenario.states_at(frames_ns))


def _tracks(scenario: Scenario, calibration: Calibration, simulator: TrackSimulator) -> Iterator[FrameTracks]:
    """What the rig's cameras see in every frame."""
    frames_ns = scenario.frames_ns
    poses = [scenario.body_poses(calibration, c, frames_ns) for c in range(len(calibration.cameras))]
    R_WB, p_WB = (np.stack(part, axis=1) for part in zip(*poses, strict=True))
    for t_ns, R, p in zip(frames_ns.tolist(), R_WB, p_WB, strict=True):

        def later(camera: int, seconds: Float, t_ns: int = t_ns) -> tuple[Float, Float]:
            rows_ns = t_ns + np.round(seconds * NS_PER_S).astype(np.int64)
            return scenario.body_poses(calibration, camera, rows_ns)

        yield simulator.observe(t_ns, R, p, later)


def _path(flight: str | Flight, duration_s: float | None, calibration: Calibration) -> tuple[Flight, float]:
    """The flight, and how long it is flown; an installed one is mounted as the first camera looks ahead."""
    if isinstance(flight, str):
        duration_s = _DURATION_S if duration_s is None else duration_s
        return named_flight(flight, duration_s, calibration.cameras[0].R_BC), duration_s
    return flight, flight.duration_s if duration_s is None else min(duration_s, flight.duration_s)


def _starting_at(bias_gyro_B: Float | None, bias_accel_B: Float | None) -> ImuErrors:
    """An IMU whose first biases are these (3,), zero where None."""
    gyro, accel = (np.zeros(3) if bias is None else np.asarray(bias) for bias in (bias_gyro_B, bias_accel_B))
    return ImuErrors(bias_gyro_B=(gyro[0], gyro[1], gyro[2]), bias_accel_B=(accel[0], accel[1], accel[2]))


def _widest_radius(camera: Camera) -> float:
    """Distance from the optical axis of the farthest image corner, on the z = 1 plane."""
    width, height = camera.resolution
    corners = camera.undistort(np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)]))
    return float(np.linalg.norm(corners, axis=1).max())
