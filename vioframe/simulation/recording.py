"""A flight through a world as a data set: what the cameras of a rig and an IMU on board would have recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from heapq import merge

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.errors import ConfigError
from vioframe.interfaces import Flight
from vioframe.io.calibration import load_calibration, packaged_calibration
from vioframe.io.trajectories import load_trajectory
from vioframe.parts.registry import Registry
from vioframe.simulation.camera import Shot, Studio, take_pictures
from vioframe.simulation.conditions import Conditions
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.flights import fit_flight, levelled
from vioframe.simulation.imu import ImuErrors, vibration
from vioframe.simulation.scenario import Scenario, fly, load_euroc
from vioframe.simulation.world import MeshWorld, check_clear, draw_movers
from vioframe.types import NS_PER_S, Calibration, FrameSet, ImuSample, Measurement

DEFAULT_DURATION_S = 30.0
# Within an exposure the image moves by this between two instants that are rendered, unless that were too many.
_BLUR_STEP_PX = 1.5
_MOST_INSTANTS = 16
# What lies this far ahead moves through the image by the camera's translation as well as by its rotation.
_TYPICAL_DEPTH_M = 3.0
# Brightness: half of it drifts, half jumps as when a lamp is switched.
_DRIFT_PERIOD_S = 7.0
_JUMP_EVERY_S = (1.5, 4.0)


class SimulatedRecording:
    """A data set that is made as it is read, by ``workers`` threads; the same whatever their number.

    ``config`` is complete. ``true_calibration`` is that of the rig which the images are rendered with, all its cameras
    triggered together; ``calibration`` is what an estimator is told. ``ground_truth`` holds a state for every reading
    of the IMU. Raises :class:`ConfigError` where the flight leads through a wall.
    """

    def __init__(self, config: SimulationConfig, registry: Registry, workers: int = 1) -> None:
        self.config = config
        self.conditions = Conditions.of(config.conditions)
        self._workers = workers
        seeds = np.random.SeedSequence(config.seed).spawn(7)
        imu_rng, world_rng, movers_rng, light_rng, drops_rng, misled_rng, shaken_rng = map(np.random.default_rng, seeds)
        known = (
            load_calibration(*config.calibration)
            if config.calibration
            else packaged_calibration("euroc", cameras=["cam0"])
        )
        if config.readout_ms is not None:
            known = _with_readout(known, [1e-3 * config.readout_ms] * len(known.cameras))
        self.true_calibration = known
        if self.conditions.readout_s:
            self.true_calibration = _with_readout(
                known, [camera.readout_s + self.conditions.readout_s for camera in known.cameras]
            )
        self._cameras = range(len(self.true_calibration.cameras))
        for camera in self.true_calibration.cameras:
            if not camera.rotation_known:
                raise ConfigError(f"rendering must know how {camera.name} is turned, and the calibration does not say")
        self.calibration = self.conditions.mislead(known, misled_rng)
        self._scenario = self._fly(registry, imu_rng)
        self.name = self._scenario.name
        self.ground_truth = self._scenario.truth
        self._imu = self._read(shaken_rng)
        self._frames_ns = self._kept(drops_rng)
        self._gains = np.ones(len(self._frames_ns))
        if self.conditions.stops:
            self._gains = _wandering_gain(self._frames_ns / NS_PER_S, self.conditions.stops, light_rng)

        t_ns = self.ground_truth.t_ns
        t_s = (t_ns - t_ns[0]) / NS_PER_S
        made = registry.create_world(config.world.name, self.ground_truth.p_WB, world_rng, config.world.options)
        self.world = MeshWorld(made.mesh, made.textures)  # checks what a plug-in made
        p_WC = np.array([self._camera_poses(camera, t_ns)[1] for camera in self._cameras])
        for path in p_WC:
            check_clear(self.world, t_s, path)
        count = self.conditions.object_count
        self._movers = draw_movers(count, t_s, p_WC, len(self.world.textures), movers_rng) if count else None

    def _fly(self, registry: Registry, rng: np.random.Generator) -> Scenario:
        config, calibration = self.config, self.true_calibration
        if config.recorded is not None:
            return load_euroc(config.recorded, start_s=config.start_s, duration_s=config.duration_s)
        if config.trajectory is not None:
            file, poses = config.trajectory.name, load_trajectory(config.trajectory)
            flight: Flight = fit_flight(poses, config.start_s, config.duration_s, name=file)
            name = file.partition(".")[0]
        else:
            # The first camera looks ahead.
            R_LB = levelled(calibration.cameras[0].R_BC)
            name, duration_s = config.flight.name, config.duration_s or DEFAULT_DURATION_S
            flight = registry.create_flight(name, duration_s, R_LB, config.flight.options)
        rate_hz = config.imu_rate_hz or calibration.imu.rate_hz
        frames_s, imu_s = (
            np.arange(int(flight.duration_s * hz + 1e-9) + 1) / hz for hz in (config.frame_rate_hz, rate_hz)
        )
        return fly(
            flight,
            name,
            rng,
            # No frame is left without its segment.
            frames_s=frames_s[frames_s <= imu_s[-1]],
            imu_s=imu_s,
            imu_rate_hz=rate_hz,
            noise=None if config.exact_imu else calibration.imu,
            errors=ImuErrors(**config.imu),
            time_offset_ns=calibration.cameras[0].time_offset_ns,
        )

    def _read(self, rng: np.random.Generator) -> list[ImuSample]:
        """The readings, shaken and late as the conditions have it."""
        t_ns, gyro_B, accel_B = self._scenario.imu_ns, self._scenario.gyro_B, self._scenario.accel_B
        if self.conditions.vibration:
            d_gyro, d_accel = vibration(self.conditions.vibration, (t_ns - t_ns[0]) / NS_PER_S, rng)
            gyro_B, accel_B = gyro_B + d_gyro, accel_B + d_accel
        return list(map(ImuSample, (t_ns + self.conditions.late_ns).tolist(), gyro_B, accel_B))

    def _kept(self, rng: np.random.Generator) -> Int:
        """The stamps of the frames that are not dropped; the first and the last stay."""
        frames_ns = self._scenario.frames_ns
        kept = rng.random(len(frames_ns)) >= self.conditions.dropped_part
        kept[[0, -1]] = True
        return frames_ns[kept]

    @property
    def frame_count(self) -> int:
        return len(self._frames_ns)

    @property
    def imu_count(self) -> int:
        return len(self._imu)

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames in the order of their stamps."""
        models = tuple(camera.model for camera in self.true_calibration.cameras)
        studio = Studio(models, self.world, self._movers, self.conditions)
        pictures = take_pictures(studio, self._shots(), self._workers)
        samples: Iterable[Measurement] = self._imu
        # As many pictures to a frame as there are cameras.
        sets = zip(*[pictures] * len(self._cameras), strict=True)
        frames: Iterable[Measurement] = map(FrameSet, self._frames_ns.tolist(), sets)
        yield from merge(samples, frames, key=lambda measurement: measurement.t_ns)

    def _shots(self) -> Iterator[Shot]:
        """Of every camera in turn, for frame after frame."""
        for index, (t_ns, gain) in enumerate(zip(self._frames_ns.tolist(), self._gains.tolist(), strict=True)):
            for camera in self._cameras:
                instants_ns = self._instants(camera, t_ns)
                R_WC, p_WC = self._camera_poses(camera, instants_ns.ravel())
                movers = None
                if self._movers is not None:
                    movers = self._movers.at((instants_ns.mean(axis=1) - self.ground_truth.t_ns[0]) / NS_PER_S)
                rolling = self.true_calibration.cameras[camera].readout_s != 0.0
                shape = instants_ns.shape if rolling else instants_ns.shape[:1]
                R_WC, p_WC = R_WC.reshape(*shape, 3, 3), p_WC.reshape(*shape, 3)
                yield Shot(camera, R_WC, p_WC, movers, gain, (self.config.seed, index, camera))

    def _instants(self, camera: int, t_ns: int) -> Int:
        """(S, R) stamps at which the exposure of R rows, or of the whole image, is rendered; the middle is ``t_ns``."""
        exposure_s, on_body = self.conditions.exposure_s, self.true_calibration.cameras[camera]
        count = self._blur_instants(camera, t_ns) if exposure_s else 1
        within = exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        of_row = np.zeros(1)
        if on_body.readout_s:
            of_row = on_body.readout_s * on_body.row(np.arange(float(on_body.model.resolution[1])))
        return self._known(t_ns + np.round((within[:, None] + of_row) * NS_PER_S).astype(np.int64))

    def _blur_instants(self, camera: int, t_ns: int) -> int:
        """How many instants of an exposure tell its blur apart from a row of sharp images."""
        half_ns = round(0.5 * self.conditions.exposure_s * NS_PER_S)
        R_WC, p_WC = self._camera_poses(camera, self._known(np.array([t_ns - half_ns, t_ns + half_ns])))
        angle = float(np.arccos(np.clip(0.5 * (np.trace(R_WC[0].T @ R_WC[1]) - 1.0), -1.0, 1.0)))
        motion = angle + float(np.linalg.norm(p_WC[1] - p_WC[0])) / _TYPICAL_DEPTH_M
        motion_px = self.true_calibration.cameras[camera].model.focal_px * motion
        return int(np.clip(np.ceil(motion_px / _BLUR_STEP_PX), 2, _MOST_INSTANTS))

    def _known(self, t_ns: Int) -> Int:
        """The motion is not known beyond the ends of the truth."""
        return np.clip(t_ns, self.ground_truth.t_ns[0], self.ground_truth.t_ns[-1])

    def _camera_poses(self, camera: int, t_ns: Int) -> tuple[Float, Float]:
        on_body = self.true_calibration.cameras[camera]
        R_WB, p_WB = self._scenario.body_poses(self.true_calibration, camera, t_ns)
        return R_WB @ on_body.R_BC, R_WB @ on_body.p_BC + p_WB


def _with_readout(calibration: Calibration, readout_s: list[float]) -> Calibration:
    """The rig with a readout time (C,) for each of its cameras."""
    pairs = zip(calibration.cameras, readout_s, strict=True)
    return replace(calibration, cameras=tuple(replace(camera, readout_s=seconds) for camera, seconds in pairs))


def _wandering_gain(t_s: Float, stops: float, rng: np.random.Generator) -> Float:
    """Gains (N,) at ascending times (N,) s, within ``stops`` powers of two of one."""
    drift = np.sin(2.0 * np.pi * (t_s / _DRIFT_PERIOD_S + rng.random()))
    count = int(np.ceil((t_s[-1] - t_s[0]) / _JUMP_EVERY_S[0])) + 1
    jumps_s = t_s[0] + np.cumsum(rng.uniform(*_JUMP_EVERY_S, count))
    level = rng.uniform(-1.0, 1.0, count + 1)[np.searchsorted(jumps_s, t_s)]
    return np.asarray(2.0 ** (0.5 * stops * (drift + level)))
