"""Matching 256-bit descriptors by the number of bits in which they differ."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Float, Int

BITS = 256

# Constants of the parallel bit count, which LLVM turns into the processor's own instruction.
_PAIRS = np.uint64(0x5555555555555555)
_QUADS = np.uint64(0x3333333333333333)
_BYTES = np.uint64(0x0F0F0F0F0F0F0F0F)
_SUM = np.uint64(0x0101010101010101)
_1, _2, _4, _56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


@kernel
def distance(a: NDArray[np.uint64], b: NDArray[np.uint64]) -> int:
    """Bits in which the descriptors (4,) differ."""
    total = np.int64(0)
    for k in range(4):
        x = a[k] ^ b[k]
        x -= (x >> _1) & _PAIRS
        x = (x & _QUADS) + ((x >> _2) & _QUADS)
        x = (x + (x >> _4)) & _BYTES
        total += np.int64((x * _SUM) >> _56)
    return int(total)


@kernel
def match(
    query: NDArray[np.uint64],
    target: NDArray[np.uint64],
    target_xy: Float,
    max_distance: int,
    ratio: float,
    apart: float,
) -> Int:
    """(N,) index of the match of each ``query`` (N, 4) among ``target`` (M, 4), or -1.

    A match is nearer than ``max_distance`` bits, and nearer than ``ratio`` times the best of all targets that lie more
    than ``apart`` from it in the image (``target_xy`` (M, 2)): one corner may be described on several scales.
    """
    found = np.full(len(query), -1)
    distances = np.empty(len(target), np.int64)
    for i in range(len(query)):
        best, at = BITS + 1, -1
        for j in range(len(target)):
            distances[j] = distance(query[i], target[j])
            if distances[j] < best:
                best, at = distances[j], j
        if best >= max_distance:
            continue
        rival = BITS + 1
        for j in range(len(target)):
            if distances[j] < rival:
                dx, dy = target_xy[j, 0] - target_xy[at, 0], target_xy[j, 1] - target_xy[at, 1]
                if dx * dx + dy * dy > apart * apart:
                    rival = distances[j]
        if best < ratio * rival:
            found[i] = at
    return found
