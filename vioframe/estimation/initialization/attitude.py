"""Attitude from gravity."""

import numpy as np

from vioframe.geometry import so3
from vioframe.types import Float


def level_rotation(up_B: Float) -> Float:
    """R_WB (3, 3) of the body whose vertical is ``up_B`` (3,), any norm: the smallest rotation that puts it upright.

    It has no part about the vertical (its twist is zero), which is what yaw zero means here. An Euler yaw would not do:
    EuRoC's IMU flies with its x axis up, where Euler angles are singular.
    """
    up = up_B / np.linalg.norm(up_B)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis), up[2]
    if sine < 1e-12:
        return np.eye(3) if cosine > 0.0 else so3.exp([np.pi, 0.0, 0.0])
    return so3.exp(axis / sine * np.arctan2(sine, cosine))
