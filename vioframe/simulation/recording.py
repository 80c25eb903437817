"""A flight through a world as a data set: what the cameras of a rig and an IMU on board would have recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from heapq import merge

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.errors import ConfigError
from vioframe.interfaces import Flight
from vioframe.io.trajectories import load_trajectory
from vioframe.parts.registry import Registry
from vioframe.simulation.camera import Shot, Studio, take_pictures
from vioframe.simulation.conditions import check_known, misled, of_cameras
from vioframe.simulation.config import SimulationConfig, rig_of
from vioframe.simulation.felt import felt
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
    triggered together unless ``delay_ms`` says otherwise; ``calibration`` is what an estimator is told. ``conditions``
    are those that each camera meets, and ``scenario`` is what happens before any of them looks: its truth,
    ``ground_truth``, holds a state for every reading of the IMU. Raises :class:`ConfigError` where the flight leads
    through a wall.
    """

    def __init__(self, config: SimulationConfig, registry: Registry, workers: int = 1) -> None:
        self.config = config
        self._workers = workers
        seeds = np.random.SeedSequence(config.seed).spawn(7)
        imu_rng, world_rng, movers_rng, light_rng, drops_rng, misled_rng, shaken_rng = map(np.random.default_rng, seeds)
        known = rig_of(config)
        names = [camera.name for camera in known.cameras]
        self.conditions = of_cameras(config.conditions, names)
        check_known("delay_ms", config.delay_ms, names)
        if config.readout_ms is not None:
            known = _with_readout(known, [1e-3 * config.readout_ms] * len(known.cameras))
        met = list(zip(known.cameras, self.conditions, strict=True))
        self.true_calibration = _with_readout(known, [camera.readout_s + own.readout_s for camera, own in met])
        # The IMU is late by the first camera; another that is not late by as much has a clock of its own.
        late_ns = [own.late_ns - self.conditions[0].late_ns for own in self.conditions]
        for index, more_ns in enumerate(late_ns):
            offset_ns = known.cameras[index].time_offset_ns + more_ns
            self.true_calibration = self.true_calibration.with_camera(index, time_offset_ns=offset_ns)
        self._cameras = range(len(self.true_calibration.cameras))
        for camera in self.true_calibration.cameras:
            if not camera.rotation_known:
                raise ConfigError(f"rendering must know how {camera.name} is turned, and the calibration does not say")
        self.calibration = misled(known, self.conditions, misled_rng)
        self.scenario = self._fly(registry, imu_rng)
        self.name = self.scenario.name
        self.ground_truth = self.scenario.truth
        self._imu = self._read(shaken_rng)
        frames_ns, taken = self._kept(drops_rng)
        self._gains = self._brightness(frames_ns, light_rng)
        self._sets = self._gathered(frames_ns, taken)

        t_ns = self.ground_truth.t_ns
        t_s = (t_ns - t_ns[0]) / NS_PER_S
        made = registry.create_world(config.world.name, self.ground_truth.p_WB, world_rng, config.world.options)
        self.world = MeshWorld(made.mesh, made.textures)  # checks what a plug-in made
        p_WC = np.array([self._camera_poses(camera, t_ns)[1] for camera in self._cameras])
        for path in p_WC:
            check_clear(self.world, t_s, path)
        count = self.conditions[0].object_count
        self._movers = draw_movers(count, t_s, p_WC, len(self.world.textures), movers_rng) if count else None

    def _fly(self, registry: Registry, rng: np.random.Generator) -> Scenario:
        config, calibration = self.config, self.true_calibration
        if config.recorded is not None:
            published = load_euroc(config.recorded, start_s=config.start_s, duration_s=config.duration_s)
            return felt(published, calibration.imu)
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
        t_ns, gyro_B, accel_B = self.scenario.imu_ns, self.scenario.gyro_B, self.scenario.accel_B
        first = self.conditions[0]
        if first.vibration:
            d_gyro, d_accel = vibration(first.vibration, (t_ns - t_ns[0]) / NS_PER_S, rng)
            gyro_B, accel_B = gyro_B + d_gyro, accel_B + d_accel
        return list(map(ImuSample, (t_ns + first.late_ns).tolist(), gyro_B, accel_B))

    def _kept(self, rng: np.random.Generator) -> tuple[Int, Bool]:
        """The times (M,) of the frames that some camera does not drop, and which cameras those are (C, M).

        None drops the first and the last one.
        """
        frames_ns = self.scenario.frames_ns
        chance = rng.random(len(frames_ns))
        kept = np.array([chance >= own.dropped_part for own in self.conditions])
        kept[:, [0, -1]] = True
        some = kept.any(axis=0)
        return frames_ns[some], kept[:, some]

    def _brightness(self, frames_ns: Int, rng: np.random.Generator) -> Float:
        """(C, M) what each camera gains of the light at each frame."""
        gains = np.ones((len(self.conditions), len(frames_ns)))
        if any(own.stops for own in self.conditions):
            wandering = _wandering(frames_ns / NS_PER_S, rng)
            gains = np.array([2.0 ** (own.stops * wandering) for own in self.conditions])
        from_middle_s = np.abs(frames_ns - 0.5 * (frames_ns[0] + frames_ns[-1])) / NS_PER_S
        for gain, own in zip(gains, self.conditions, strict=True):
            gain[from_middle_s < 0.5 * own.black_s] = 0.0
        return gains

    def _gathered(self, frames_ns: Int, taken: Bool) -> list[tuple[int, dict[int, int]]]:
        """Stamps in ascending order, and by the cameras that take an image there the number of the frame it is of.

        What would be taken after the last frame is not: it might have no readings behind it.
        """
        sets: dict[int, dict[int, int]] = {}
        for index, camera in np.argwhere(taken.T).tolist():
            delay_ms = self.config.delay_ms.get(self.true_calibration.cameras[camera].name, 0.0)
            t_ns = int(frames_ns[index]) + round(1e6 * delay_ms)
            if t_ns <= frames_ns[-1]:
                sets.setdefault(t_ns, {})[camera] = index
        return sorted(sets.items())

    @property
    def frame_count(self) -> int:
        return len(self._sets)

    @property
    def imu_count(self) -> int:
        return len(self._imu)

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames in the order of their stamps."""
        models = tuple(camera.model for camera in self.true_calibration.cameras)
        studio = Studio(models, self.world, self._movers, self.conditions)
        pictures = take_pictures(studio, self._shots(), self._workers)
        samples: Iterable[Measurement] = self._imu
        frames: Iterable[Measurement] = (
            FrameSet(t_ns, tuple(next(pictures) if camera in taken else None for camera in self._cameras))
            for t_ns, taken in self._sets
        )
        yield from merge(samples, frames, key=lambda measurement: measurement.t_ns)

    def _shots(self) -> Iterator[Shot]:
        """Of every camera in turn, for set after set."""
        for t_ns, taken in self._sets:
            for camera, index in sorted(taken.items()):
                instants_ns = self._instants(camera, t_ns)
                R_WC, p_WC = self._camera_poses(camera, instants_ns.ravel())
                movers = None
                if self._movers is not None:
                    movers = self._movers.at((instants_ns.mean(axis=1) - self.ground_truth.t_ns[0]) / NS_PER_S)
                rolling = self.true_calibration.cameras[camera].readout_s != 0.0
                shape = instants_ns.shape if rolling else instants_ns.shape[:1]
                R_WC, p_WC = R_WC.reshape(*shape, 3, 3), p_WC.reshape(*shape, 3)
                gain, seed = float(self._gains[camera, index]), (self.config.seed, index, camera)
                yield Shot(camera, R_WC, p_WC, movers, gain, seed)

    def _instants(self, camera: int, t_ns: int) -> Int:
        """(S, R) stamps at which the exposure of R rows, or of the whole image, is rendered; the middle is ``t_ns``."""
        exposure_s, on_body = self.conditions[camera].exposure_s, self.true_calibration.cameras[camera]
        count = self._blur_instants(camera, t_ns) if exposure_s else 1
        within = exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        of_row = np.zeros(1)
        if on_body.readout_s:
            of_row = on_body.readout_s * on_body.row(np.arange(float(on_body.model.resolution[1])))
        return self._known(t_ns + np.round((within[:, None] + of_row) * NS_PER_S).astype(np.int64))

    def _blur_instants(self, camera: int, t_ns: int) -> int:
        """How many instants of an exposure tell its blur apart from a row of sharp images."""
        half_ns = round(0.5 * self.conditions[camera].exposure_s * NS_PER_S)
        R_WC, p_WC = self._camera_poses(camera, self._known(np.array([t_ns - half_ns, t_ns + half_ns])))
        angle = float(np.arccos(np.clip(0.5 * (np.trace(R_WC[0].T @ R_WC[1]) - 1.0), -1.0, 1.0)))
        motion = angle + float(np.linalg.norm(p_WC[1] - p_WC[0])) / _TYPICAL_DEPTH_M
        motion_px = self.true_calibration.cameras[camera].model.focal_px * motion
        return int(np.clip(np.ceil(motion_px / _BLUR_STEP_PX), 2, _MOST_INSTANTS))

    def _known(self, t_ns: Int) -> Int:
        """The motion is not known beyond the ends of the truth."""
        return np.clip(t_ns, self.ground_truth.t_ns[0], self.ground_truth.t_ns[-1])

    def _camera_poses(self, camera: int, t_ns: Int) -> tuple[Float, Float]:
        return self.true_calibration.cameras[camera].pose(
            *self.scenario.body_poses(self.true_calibration, camera, t_ns)
        )


def _with_readout(calibration: Calibration, readout_s: list[float]) -> Calibration:
    """The rig with a readout time (C,) for each of its cameras."""
    pairs = zip(calibration.cameras, readout_s, strict=True)
    return replace(calibration, cameras=tuple(replace(camera, readout_s=seconds) for camera, seconds in pairs))


def _wandering(t_s: Float, rng: np.random.Generator) -> Float:
    """(N,) between -1 and 1 at ascending times (N,) s."""
    drift = np.sin(2.0 * np.pi * (t_s / _DRIFT_PERIOD_S + rng.random()))
    count = int(np.ceil((t_s[-1] - t_s[0]) / _JUMP_EVERY_S[0])) + 1
    jumps_s = t_s[0] + np.cumsum(rng.uniform(*_JUMP_EVERY_S, count))
    level = rng.uniform(-1.0, 1.0, count + 1)[np.searchsorted(jumps_s, t_s)]
    return np.asarray(0.5 * (drift + level))
