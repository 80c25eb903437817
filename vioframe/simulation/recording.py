"""A flight through a world as a data set: the measurements that a camera and an IMU on board would have recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property
from heapq import merge

import numpy as np

from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Flight
from vioframe.io.calibration import load_calibration, packaged_calibration
from vioframe.parts.registry import Registry
from vioframe.simulation.brightness import wandering_gain
from vioframe.simulation.camera import Shot, Studio, take_pictures
from vioframe.simulation.conditions import Conditions
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.flights import levelled
from vioframe.simulation.imu import ImuErrors
from vioframe.simulation.movers import draw_movers
from vioframe.simulation.recorded_flight import flight_from_file
from vioframe.simulation.recorded_motion import load_recorded_motion
from vioframe.simulation.scenario import Scenario, flown, replayed
from vioframe.simulation.vibration import ACCEL_RMS, GYRO_RMS, vibration
from vioframe.simulation.world import MeshWorld, check_clear
from vioframe.types import NS_PER_S, Float, Frame, ImuSample, Int, Measurement, NavState

DEFAULT_DURATION_S = 30.0
# Within an exposure the image moves by this between two instants that are rendered, unless that were too many.
_BLUR_STEP_PX = 1.5
_MOST_INSTANTS = 16
# What lies this far ahead moves through the image by the camera's translation as well as by its rotation.
_TYPICAL_DEPTH_M = 3.0


class SimulatedRecording:
    """A data set that is made as it is read, by ``workers`` processes; the same whatever their number.

    ``config`` is complete. ``true_calibration`` is what the images are rendered with, ``calibration`` what an estimator
    is told. ``truth`` holds a state for every reading of the IMU. Raises :class:`ConfigError` where the flight leads
    through a wall.
    """

    def __init__(self, config: SimulationConfig, registry: Registry, workers: int = 1) -> None:
        self.config = config
        self.conditions = Conditions.of(config.conditions)
        self._workers = workers
        seeds = np.random.SeedSequence(config.seed).spawn(7)
        imu_rng, world_rng, movers_rng, light_rng, drops_rng, misled_rng, shaken_rng = map(np.random.default_rng, seeds)
        self.true_calibration = (
            load_calibration(*config.calibration) if config.calibration else packaged_calibration("euroc")
        )
        self.calibration = self.conditions.mislead(self.true_calibration, misled_rng)
        self._scenario, self.name = self._motion(registry, imu_rng)
        self._imu = self._read(shaken_rng)
        self._frames_ns = _dropped(self._scenario.frames_ns, self.conditions.dropped_part, drops_rng)
        self._gains = np.ones(len(self._frames_ns))
        if self.conditions.stops:
            self._gains = wandering_gain(self._frames_ns / NS_PER_S, self.conditions.stops, light_rng)

        t_ns = np.array([state.t_ns for state in self.truth], np.int64)
        p_WB, p_WC = np.array([state.p_WB for state in self.truth]), self._camera_poses(t_ns)[1]
        made = registry.create_world(config.world.name, p_WB, world_rng, config.world.options)
        self.world = MeshWorld(made.mesh, made.textures)  # checks what a plug-in made
        t_s = (t_ns - t_ns[0]) / NS_PER_S
        check_clear(self.world, t_s, p_WC)
        self._begin_ns = int(t_ns[0])
        count = self.conditions.object_count
        self._movers = draw_movers(count, t_s, p_WC, len(self.world.textures), movers_rng) if count else None

    def _motion(self, registry: Registry, rng: np.random.Generator) -> tuple[Scenario, str]:
        config, calibration = self.config, self.true_calibration
        if config.recorded is not None:
            recorded = load_recorded_motion(config.recorded, start_s=config.start_s, duration_s=config.duration_s)
            return replayed(recorded), recorded.name
        if config.trajectory is not None:
            flight: Flight = flight_from_file(config.trajectory, config.start_s, config.duration_s)
            name = config.trajectory.name.partition(".")[0]
        else:
            R_LB = levelled(calibration.R_BC)
            name, duration_s = config.flight.name, config.duration_s or DEFAULT_DURATION_S
            flight = registry.create_flight(name, duration_s, R_LB, config.flight.options)
        scenario = flown(
            flight,
            calibration,
            rng,
            noise=None if config.exact_imu else calibration.imu,
            errors=ImuErrors(**config.imu),
            imu_rate_hz=config.imu_rate_hz or calibration.imu.rate_hz,
            frame_rate_hz=config.frame_rate_hz,
        )
        return scenario, name

    def _read(self, rng: np.random.Generator) -> list[ImuSample]:
        """The readings, shaken and late as the conditions have it."""
        samples, level, late_ns = self._scenario.imu, self.conditions.vibration, self.conditions.late_ns
        shaken = np.zeros((len(samples), 6))
        if level:
            t_s = np.array([sample.t_ns - samples[0].t_ns for sample in samples]) / NS_PER_S
            shaken = level * vibration(t_s, rng) * np.repeat([ACCEL_RMS, GYRO_RMS], 3)
        return [
            ImuSample(sample.t_ns + late_ns, sample.gyro_B + d[3:], sample.accel_B + d[:3])
            for sample, d in zip(samples, shaken, strict=True)
        ]

    @property
    def truth(self) -> tuple[NavState, ...]:
        return self._scenario.truth

    @property
    def frame_count(self) -> int:
        return len(self._frames_ns)

    @property
    def imu_count(self) -> int:
        return len(self._imu)

    @cached_property
    def ground_truth(self) -> Trajectory:
        return Trajectory(
            np.array([state.t_ns for state in self.truth], np.int64),
            np.array([state.R_WB for state in self.truth]),
            np.array([state.p_WB for state in self.truth]),
        )

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames in the order of their stamps."""
        pictures = take_pictures(self._studio, self._shots(), self._workers)
        samples: Iterable[Measurement] = self._imu
        frames: Iterable[Measurement] = map(Frame, self._frames_ns.tolist(), pictures)
        yield from merge(samples, frames, key=lambda measurement: measurement.t_ns)

    @property
    def _studio(self) -> Studio:
        conditions = self.conditions
        return Studio(
            self.true_calibration.camera,
            self.world,
            self._movers,
            contrast=conditions.contrast,
            fog_per_m=conditions.fog_per_m,
            light=conditions.light,
            noise_deviation=conditions.noise_deviation,
            dynamic_range=conditions.dynamic_range,
        )

    def _shots(self) -> Iterator[Shot]:
        for index, (t_ns, gain) in enumerate(zip(self._frames_ns.tolist(), self._gains.tolist(), strict=True)):
            instants_ns = self._instants(t_ns)
            R_WC, p_WC = self._camera_poses(instants_ns.ravel())
            movers = None
            if self._movers is not None:
                movers = self._movers.at((instants_ns.mean(axis=1) - self._begin_ns) / NS_PER_S)
            shape = instants_ns.shape if self.conditions.readout_s else instants_ns.shape[:1]
            yield Shot(R_WC.reshape(*shape, 3, 3), p_WC.reshape(*shape, 3), movers, gain, (self.config.seed, index))

    def _instants(self, t_ns: int) -> Int:
        """(S, R) stamps at which the exposure of R rows, or of the whole image, is rendered; the middle is ``t_ns``."""
        exposure_s, readout_s = self.conditions.exposure_s, self.conditions.readout_s
        rows = self.true_calibration.camera.resolution[1] if readout_s else 1
        count = self._blur_instants(t_ns, exposure_s) if exposure_s else 1
        within = exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        of_row = readout_s * ((np.arange(rows) + 0.5) / rows - 0.5)
        offsets_ns = np.round((within[:, None] + of_row) * NS_PER_S).astype(np.int64)
        # The motion is not known beyond its ends.
        return np.clip(t_ns + offsets_ns, self.truth[0].t_ns, self.truth[-1].t_ns)

    def _blur_instants(self, t_ns: int, exposure_s: float) -> int:
        """How many instants of an exposure tell its blur apart from a row of sharp images."""
        half_ns = round(0.5 * exposure_s * NS_PER_S)
        ends_ns = np.clip([t_ns - half_ns, t_ns + half_ns], self.truth[0].t_ns, self.truth[-1].t_ns)
        R_WC, p_WC = self._camera_poses(ends_ns)
        angle = float(np.arccos(np.clip(0.5 * (np.trace(R_WC[0].T @ R_WC[1]) - 1.0), -1.0, 1.0)))
        motion = angle + float(np.linalg.norm(p_WC[1] - p_WC[0])) / _TYPICAL_DEPTH_M
        motion_px = self.true_calibration.camera.focal_px * motion
        return int(np.clip(np.ceil(motion_px / _BLUR_STEP_PX), 2, _MOST_INSTANTS))

    def _camera_poses(self, t_ns: Int) -> tuple[Float, Float]:
        R_WB, p_WB = self._scenario.poses(t_ns)
        calibration = self.true_calibration
        return R_WB @ calibration.R_BC, R_WB @ calibration.p_BC + p_WB


def _dropped(frames_ns: Int, part: float, rng: np.random.Generator) -> Int:
    """All but ``part`` of the stamps (N,), at random; the first and the last stay."""
    kept = rng.random(len(frames_ns)) >= part
    kept[[0, -1]] = True
    return frames_ns[kept]
