"""Simulated cameras at work: light gathered through an exposure, then amplified, read out with noise and digitised."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from vioframe.arrays import Float, Image
from vioframe.geometry.cameras import Camera
from vioframe.interfaces import World
from vioframe.simulation.conditions import Conditions
from vioframe.simulation.rasterizer import Float32
from vioframe.simulation.renderer import Renderer
from vioframe.simulation.world import Movers

_MIDDLE_GREY = 0.4
# Electrons of a white pixel at a gain of one: their shot noise is what low light is noisy by.
_FULL_WELL = 10_000.0
_READ_NOISE = 0.002
_WHITE = 255.0


@dataclass(frozen=True)
class Shot:
    """One picture to take, with a camera of the studio: its poses at S instants of the exposure, and how it is exposed.

    ``R_WC`` (S, 3, 3) and ``p_WC`` (S, 3) m; with a rolling shutter (S, height, 3, 3) and (S, height, 3). ``p_WM``
    (S, M, 3) m is where the movers are, or None. ``gain`` is that of the whole exposure; ``seed`` that of its noise.
    """

    camera: int
    R_WC: Float
    p_WC: Float
    p_WM: Float | None
    gain: float
    seed: tuple[int, ...]


@dataclass(frozen=True)
class Studio:
    """All that is the same for every picture: world, optics, sensors, and the ``conditions`` that each camera meets."""

    cameras: tuple[Camera, ...]
    world: World
    movers: Movers | None = None
    conditions: tuple[Conditions, ...] = (Conditions(),)


class Photographer:
    """Takes the pictures of a studio, the same ones for the same shots."""

    def __init__(self, studio: Studio) -> None:
        self._conditions = studio.conditions
        self._renderers = [
            Renderer(camera, studio.world, studio.movers, contrast=met.contrast, fog_per_m=met.fog_per_m)
            for camera, met in zip(studio.cameras, studio.conditions, strict=True)
        ]

    def take(self, shot: Shot) -> Image:
        """(height, width) uint8."""
        conditions, renderer = self._conditions[shot.camera], self._renderers[shot.camera]
        movers = [None] * len(shot.p_WC) if shot.p_WM is None else shot.p_WM
        light = np.mean([renderer.render(*at) for at in zip(shot.R_WC, shot.p_WC, movers, strict=True)], axis=0)
        if conditions.dynamic_range != 1.0:
            light = _MIDDLE_GREY * (light / _MIDDLE_GREY) ** conditions.dynamic_range
        rng, noise_deviation = np.random.default_rng(shot.seed), conditions.noise_deviation
        return digitise(light, rng, gain=shot.gain, exposed=conditions.light, noise_deviation=noise_deviation)


def digitise(
    light: Float32,
    rng: np.random.Generator,
    *,
    gain: float = 1.0,
    exposed: float = 1.0,
    noise_deviation: float = 0.0,
) -> Image:
    """What a sensor makes of ``light`` (H, W), 1 for white, times ``gain``: (H, W) uint8.

    ``exposed`` is the part of full light there is, which an amplifier makes up for; ``noise_deviation`` is added to
    that of the sensor itself, 1 is white. In full light and without it there is no noise, and ``rng`` is left alone.
    """
    value = light * gain
    if exposed < 1.0 or noise_deviation > 0.0:
        # Shot noise is that of the electrons gathered; the gain amplifies it and the read-out noise alike.
        amplification = gain / exposed
        shot_variance = np.maximum(light, 0.0) * exposed / _FULL_WELL
        deviation = np.sqrt(amplification**2 * (shot_variance + _READ_NOISE**2) + noise_deviation**2)
        value = value + deviation * rng.standard_normal(light.shape, dtype=np.float32)
    image: Image = np.clip(np.round(_WHITE * value), 0.0, _WHITE).astype(np.uint8)
    return image


def take_pictures(studio: Studio, shots: Iterable[Shot], workers: int) -> Iterator[Image]:
    """The pictures in the order of the shots, taken by ``workers`` threads: compiled loops run side by side."""
    take = Photographer(studio).take
    pool = ThreadPoolExecutor(workers)
    waiting: deque[Future[Image]] = deque()
    try:
        for shot in shots:
            waiting.append(pool.submit(take, shot))
            # A few ahead for each, and no more: shots and pictures must not pile up.
            if len(waiting) > 4 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
