"""Compiles the kernels, or loads them from the cache, before the first frame comes."""

from __future__ import annotations

import numpy as np

from vioframe_pose_graph.hamming import match
from vioframe_pose_graph.index import DescriptorIndex
from vioframe_pose_graph.two_point import ransac


def warm_up() -> None:
    """Call every kernel once with the types that it will be called with."""
    descriptors = np.zeros((2, 4), np.uint64)
    index = DescriptorIndex()
    index.add(descriptors, 0)
    index.similarity(descriptors, 1)
    match(descriptors, descriptors, np.zeros((2, 2)), 1, 1.0, 1.0)
    side, cameras = np.zeros(2, np.int64), np.repeat(np.eye(3)[None], 2, axis=0)
    ransac(np.eye(2, 3), np.zeros((2, 2)), side, cameras, np.zeros((2, 3)), np.array([[0, 1]]), 1.0)
