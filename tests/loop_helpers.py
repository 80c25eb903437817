"""Keyframes for loop closers: rendered pictures along a path, as an odometry with a known drift would place them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from simulation_helpers import INSTALLED, small_calibration

from vioframe.geometry.meshes import ray_scene
from vioframe.geometry.so3 import rotation_z
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import World
from vioframe.simulation.flights import levelled
from vioframe.simulation.renderer import Renderer
from vioframe.simulation.textures import procedural_textures
from vioframe.simulation.world import MeshBuilder, MeshWorld
from vioframe.types import NS_PER_S, Calibration, Estimate, Float, FrameSet, FrameTracks, NavState, Status, Step

CALIBRATION: Calibration = small_calibration(2)
CAMERA = CALIBRATION.cameras[0]
_START_NS = 5 * NS_PER_S
_FEATURES = 120


@dataclass(frozen=True)
class Flown:
    """What a loop closer sees of a flight, and where the body was in truth and by the odometry."""

    steps: tuple[Step, ...]
    truth: Trajectory
    odometry: Trajectory


def path_along(p_W: Float, yaws: Float | None = None, interval_s: float = 0.5) -> Trajectory:
    """A flight through the positions (N, 3), the camera level, ahead or at ``yaws`` (N,) rad."""
    if yaws is None:
        heading = np.gradient(p_W, axis=0)
        yaws = np.arctan2(heading[:, 1], heading[:, 0])
    R_LB = levelled(CAMERA.R_BC)
    t_ns = _START_NS + np.round(np.arange(len(p_W)) * interval_s * NS_PER_S).astype(np.int64)
    return Trajectory(t_ns, np.array([rotation_z(yaw) @ R_LB for yaw in yaws]), p_W)


def drifting(truth: Trajectory, rng: np.random.Generator, m_per_m: float, deg_per_s: float) -> tuple[Float, Float]:
    """Yaw (N,) and offset (N, 3) of a random walk: ``m_per_m`` m after a metre, ``deg_per_s`` deg after a second."""
    way, dt = np.diff(truth.travelled_m, prepend=0.0), np.diff(truth.t_ns, prepend=truth.t_ns[0]) * 1e-9
    yaw = np.cumsum(rng.standard_normal(len(truth)) * np.radians(deg_per_s) * np.sqrt(dt))
    offset = np.cumsum(rng.standard_normal((len(truth), 3)) * (m_per_m * np.sqrt(way))[:, None], axis=0)
    return yaw, offset


def fly(
    truth: Trajectory, world: World, rng: np.random.Generator, *, m_per_m: float = 0.05, deg_per_s: float = 0.1
) -> Flown:
    """Take a picture at every pose of ``truth``; landmarks are where the odometry, which drifts, sees them."""
    yaw, offset = drifting(truth, rng, m_per_m, deg_per_s)
    # Yaw errors turn the way ahead, not the place where they happen.
    steps_W = np.diff(truth.p_WB, axis=0, prepend=truth.p_WB[:1])
    turns = np.array([rotation_z(angle) for angle in yaw])
    p_O = np.cumsum(np.einsum("nij,nj->ni", turns, steps_W), axis=0) + truth.p_WB[0] + offset
    odometry = Trajectory(truth.t_ns, turns @ truth.R_WB, p_O)
    steps = tuple(_steps(truth, odometry, turns, world, rng))
    return Flown(steps, truth, odometry)


def _steps(
    truth: Trajectory, odometry: Trajectory, turns: Float, world: World, rng: np.random.Generator
) -> Iterator[Step]:
    renderer, scene = Renderer(CAMERA.model, world), ray_scene(world.mesh.corners)
    for k, t_ns in enumerate(truth.t_ns.tolist()):
        R_WC = truth.R_WB[k] @ CAMERA.R_BC
        p_WC = truth.p_WB[k] + truth.R_WB[k] @ CAMERA.p_BC
        light = renderer.render(R_WC, p_WC) + 0.01 * rng.standard_normal(CAMERA.model.resolution[::-1])
        image = np.clip(255.0 * light, 0.0, 255.0).astype(np.uint8)
        xy = cv2.goodFeaturesToTrack(image, _FEATURES, 0.01, 8).reshape(-1, 2).astype(np.float64)
        xy_normalised = CAMERA.model.undistort(xy)
        depth, rays = depths(scene, R_WC, p_WC, xy_normalised)
        # A landmark is known to a per cent of its distance.
        depth = depth * (1.0 + 0.01 * rng.standard_normal(len(depth)))
        p_WF = p_WC + depth[:, None] * rays
        p_OF = (p_WF - truth.p_WB[k]) @ turns[k].T + odometry.p_WB[k]
        ids = k * _FEATURES + np.arange(len(xy))
        unknown = np.zeros(3)
        state = NavState(t_ns, odometry.R_WB[k], odometry.p_WB[k], unknown, unknown, unknown)
        estimate = Estimate(Status.TRACKING, state, ids, p_OF)
        tracks = FrameTracks(t_ns, ids, np.zeros_like(ids), xy, xy_normalised)
        yield Step(FrameSet(t_ns, (image,)), tracks, estimate, {})


def depths(scene: object, R_WC: Float, p_WC: Float, xy_normalised: Float) -> tuple[Float, Float]:
    """(N,) how far along its ray (N, 3), of depth 1, each point ``xy_normalised`` (N, 2) of the z = 1 plane lies, m."""
    import open3d

    rays = np.column_stack([xy_normalised, np.ones(len(xy_normalised))]) @ R_WC.T
    packed = np.concatenate([np.broadcast_to(p_WC, rays.shape), rays], axis=1).astype(np.float32)
    hits = scene.cast_rays(open3d.core.Tensor.from_numpy(packed), nthreads=1)  # type: ignore[attr-defined]
    return hits["t_hit"].numpy().astype(np.float64), rays


def hall(truth: Trajectory, seed: int) -> World:
    """The built-in hall around a path."""
    return INSTALLED.create_world("hall", truth.p_WB, np.random.default_rng(seed), {})


def tiled_corridor(length_m: float, tile_m: float, seed: int) -> World:
    """A straight corridor along x, 5 m wide and 3.5 m high, all of it laid out with one texture."""
    builder = MeshBuilder()
    low, high = np.array([-10.0, -2.5, -1.5]), np.array([length_m + 10.0, 2.5, 2.0])
    builder.box(low, high, np.zeros(6, np.int64), tile_m, np.zeros(2))
    return MeshWorld(builder.build(), procedural_textures(np.random.default_rng(seed), 1))
