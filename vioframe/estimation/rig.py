"""How well the cameras of a rig are known: each to so much, all of them together to less."""

from __future__ import annotations

import numpy as np

from vioframe.types import CalibrationEstimate, Float

# To this the cameras of a rig are known beside each other, rad, m and s: by what they saw together, while only motion
# tells how all of them sit on the IMU. What the first one's standard deviations have beyond it is common to all.
_BESIDE = np.full(7, 0.001)


def covariance(prior: CalibrationEstimate) -> Float:
    """(16 N, 16 N) of a rig's calibration, each camera's in the order of :meth:`CameraSigma.stacked`.

    What is zero in the standard deviations of the first camera's pose and time offset is so in all.
    """
    cameras, first = prior.calibration.cameras, prior.sigma[0].stacked()
    count, pose = len(cameras), slice(0, len(_BESIDE))
    if count == 1:
        return np.diag(first**2)
    own = np.stack([sigma.stacked() for sigma in prior.sigma])
    own[:, pose] = np.minimum(_BESIDE, first[pose])
    common = np.zeros((count, len(first), len(_BESIDE)))
    for c, camera in enumerate(cameras):
        # A turn of the whole rig, in the axes of each camera, and one move and delay of all.
        common[c, 0:3, 0:3] = camera.R_BC.T @ cameras[0].R_BC
        common[c, 3:7, 3:7] = np.eye(4)
    J = common.reshape(-1, len(_BESIDE)) * np.sqrt(first[pose] ** 2 - own[0, pose] ** 2)
    return np.asarray(J @ J.T + np.diag(own.ravel() ** 2))
