"""Local bundle adjustment: the newest keyframes and all points brought to agree, the oldest keyframes held.

The keyframes held, and nothing else, keep the map's scale: what they leave open is the drift that the filter allows
for. Factors and solver are those of :mod:`vioframe.estimation.factors`, of whose states the poses alone have a part.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.landmarks import in_hosts, positions
from vioframe.estimation.factors.problem import Prior, Problem, Variables, pose_columns
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, Calibrated, Sightings
from vioframe.estimation.factors.solver import solve
from vioframe_loose_ekf.measurement import VisionPose
from vioframe_loose_ekf.vision_map import VisionMap

_WIDTH = 2.0
"""Of Cauchy's loss, standard deviations."""
# A point that is off by more than this (root mean square) is no point, standard deviations.
_LARGEST_ERROR = 3.0
# Holds a keyframe that has lost all its points; far below what one point says, in units of V and rad.
_UNSEEING = 1e-6


def adjust(scene: VisionMap, sigma: float, held: int, iterations: int) -> None:
    """Improve the map ``scene`` in place, its ``held`` oldest keyframes fixed; points that do not fit are dropped.

    ``sigma`` is the noise on the z = 1 plane.
    """
    xy = np.ascontiguousarray(np.swapaxes(scene.sightings(scene.ids), 0, 1))
    seen = ~np.isnan(xy[..., 0])
    hosts = seen.argmax(axis=1)
    R_VC, p_VC = scene.poses()
    states = StateArrays(R_VC, p_VC, *np.zeros((3, len(p_VC), 3)))
    camera = Calibrated(np.eye(3), np.zeros(3))
    landmarks, in_front = in_hosts(states, camera, hosts, scene.p_VF)
    seen &= in_front[:, None]

    columns = pose_columns(len(states))[:-CALIBRATION_SIZE]
    n = 15 * len(states) + CALIBRATION_SIZE
    weak = Prior(_UNSEEING * np.eye(n), np.zeros(n), states, camera, np.ones(len(states), bool))
    to_plane = np.tile(np.eye(2), (*seen.shape, 1, 1))
    sightings = Sightings(seen, xy, np.zeros(xy.shape), to_plane, sigma, _WIDTH)
    problem = Problem(weak, ImuFactors.stack([]), {}, sightings, first_estimates=False)
    x = solve(problem, Variables(states, camera, landmarks), columns[6 * held :], iterations).variables

    poses = zip(scene.keyframes, x.states.R_WB, x.states.p_WB, strict=True)
    scene.keyframes = [replace(keyframe, pose=VisionPose(R, p)) for keyframe, R, p in poses]
    scene.p_VF = positions(x.states, camera, hosts, x.landmarks)
    errors = np.sqrt(2.0) * sightings.errors(x.poses, camera, x.landmarks)
    scene.keep(in_front & (errors < _LARGEST_ERROR) & (x.landmarks[:, 2] > 0.0))
