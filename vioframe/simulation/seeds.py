"""Which simulated worlds are for what: no surface that a part was trained or tuned on is one it is reported on.

The seed of a simulation draws the textures of its world, the same in every flight and world of that seed. So ranges of
seeds that do not meet keep them apart. Seeds beyond the last are nobody's.
"""

from __future__ import annotations

from typing import Literal

from vioframe.errors import ConfigError

Purpose = Literal["training", "tuning", "reporting"]

SEEDS: dict[Purpose, range] = {"training": range(1000), "tuning": range(1000, 3000), "reporting": range(3000, 4000)}


def seed_for(purpose: Purpose, number: int) -> int:
    """The seed of the ``number``-th world for ``purpose``; raises :class:`ConfigError` where there are not so many."""
    seeds = SEEDS[purpose]
    if number >= len(seeds):
        raise ConfigError(f"there are {len(seeds)} worlds for {purpose}, 0 to {len(seeds) - 1}, and no {number}")
    return seeds[number]


def purpose_of(seed: int) -> Purpose | None:
    """What the world of ``seed`` is for, None where it is nobody's."""
    return next((purpose for purpose, seeds in SEEDS.items() if seed in seeds), None)
