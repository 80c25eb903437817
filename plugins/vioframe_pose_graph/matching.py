"""Binary descriptors: matched by the bits in which they differ, and an index of which earlier keyframes look like one.

Multi-index hashing (Norouzi, Punjani, Fleet, CVPR 2012): a descriptor is cut into 16 words of 16 bits, and each word
has a table from its value to the descriptors that hold it. Two descriptors that differ in few bits agree in some word,
so looking up 16 lists finds most near ones; each found is then compared in full. No vocabulary has to be learnt.
"""

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
_TABLES, _VALUES = 16, 1 << 16
_MAX_DISTANCE = 48
# A word that more than one in so many descriptors hold says little, whatever the camera sees; it is not looked up.
_COMMON, _NEVER_COMMON = 4096, 50


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


class DescriptorIndex:
    """Grows by a keyframe at a time, and holds its descriptors."""

    def __init__(self) -> None:
        self._heads = np.full((_TABLES, _VALUES), -1, np.int32)
        self._lengths = np.zeros((_TABLES, _VALUES), np.int32)
        self._next = np.empty((_TABLES, 1024), np.int32)
        self._descriptors = np.empty((1024, 4), np.uint64)
        self._owners = np.empty(1024, np.int32)
        self._size = 0

    def add(self, descriptors: NDArray[np.uint64], keyframe: int) -> slice:
        """Add the descriptors (K, 4) of a keyframe, of a higher number than those before; returns their rows."""
        end = self._size + len(descriptors)
        if end > len(self._descriptors):
            more = max(end - len(self._descriptors), len(self._descriptors) // 4)
            self._next = np.concatenate([self._next, np.empty((_TABLES, more), np.int32)], axis=1)
            self._descriptors = np.concatenate([self._descriptors, np.empty((more, 4), np.uint64)])
            self._owners = np.concatenate([self._owners, np.empty(more, np.int32)])
        rows = slice(self._size, end)
        self._descriptors[rows] = descriptors
        self._owners[rows] = keyframe
        words = np.ascontiguousarray(descriptors).view(np.uint16).reshape(-1, _TABLES)
        _insert(self._heads, self._lengths, self._next, words, self._size)
        self._size = end
        return rows

    def descriptors(self, rows: slice) -> NDArray[np.uint64]:
        """(K, 4) those that were added as ``rows``."""
        return self._descriptors[rows]

    def similarity(self, descriptors: NDArray[np.uint64], before: int) -> Float:
        """(before,) for each of the first ``before`` keyframes, the part of ``descriptors`` (K, 4) that is found there.

        A descriptor found in many keyframes tells little about the place, and counts by its inverse frequency.
        """
        words = np.ascontiguousarray(descriptors).view(np.uint16).reshape(-1, _TABLES)
        longest = max(self._size // _COMMON, _NEVER_COMMON)
        scores = np.zeros(before)
        _vote(
            self._heads,
            self._lengths,
            self._next,
            self._descriptors,
            self._owners,
            descriptors,
            words,
            longest,
            scores,
        )
        return scores / max(len(descriptors), 1)


@kernel
def _insert(
    heads: NDArray[np.int32],
    lengths: NDArray[np.int32],
    following: NDArray[np.int32],
    words: NDArray[np.uint16],
    start: int,
) -> None:
    for i in range(len(words)):
        for t in range(_TABLES):
            value = words[i, t]
            following[t, start + i] = heads[t, value]
            heads[t, value] = start + i
            lengths[t, value] += 1


@kernel
def _vote(
    heads: NDArray[np.int32],
    lengths: NDArray[np.int32],
    following: NDArray[np.int32],
    descriptors: NDArray[np.uint64],
    owners: NDArray[np.int32],
    query: NDArray[np.uint64],
    words: NDArray[np.uint16],
    longest: int,
    scores: Float,
) -> None:
    before = len(scores)
    last_asked = np.full(before, -1, np.int64)
    found = np.empty(before, np.int64)
    for i in range(len(query)):
        count = 0
        for t in range(_TABLES):
            value = words[i, t]
            if lengths[t, value] > longest:
                continue
            entry = heads[t, value]
            while entry >= 0:
                owner = owners[entry]
                if owner < before and last_asked[owner] != i and distance(query[i], descriptors[entry]) < _MAX_DISTANCE:
                    last_asked[owner] = i
                    found[count] = owner
                    count += 1
                entry = following[t, entry]
        if count:
            weight = np.log((before + 1.0) / count)
            for k in range(count):
                scores[found[k]] += weight
