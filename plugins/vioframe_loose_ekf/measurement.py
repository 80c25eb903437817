"""What the visual odometry should say of the camera, given the filter's state; the derivatives; and what it did say.

Weiss et al. (2012), eq. (13)-(14), with the anchor in place of V's origin and the error of the rotation on the right:

    p_VC = p_VA + lambda R_WV^T (p_WB + R_WB p_BC - p_WA)
    R_VC = R_WV^T R_WB R_BC
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.types import DP, DTHETA, Calibration, Float
from vioframe_loose_ekf.state import DP_WA, DTHETA_WV, LOG_SCALE, SIZE, FilterState


@dataclass(frozen=True, slots=True)
class VisionPose:
    """Pose of the camera in V: ``R_VC`` (3, 3) and ``p_VC`` (3,) in V's units."""

    R_VC: Float
    p_VC: Float


def predicted_pose(state: FilterState, calibration: Calibration) -> VisionPose:
    """The camera's pose in V as ``state`` has it."""
    R_VB = state.R_WV.T @ state.R_WB
    p_WC = state.p_WB + state.R_WB @ calibration.cameras[0].p_BC
    return VisionPose(R_VB @ calibration.cameras[0].R_BC, state.p_VA + state.scale * state.R_WV.T @ (p_WC - state.p_WA))


def residual(measured: VisionPose, predicted: VisionPose) -> Float:
    """(6,) [rotation, position] of ``measured`` beyond ``predicted``; the rotation in the axes of the camera, rad."""
    return np.concatenate(
        [so3.log(predicted.R_VC.T @ measured.R_VC), np.asarray(measured.p_VC - predicted.p_VC, np.float64)]
    )


def jacobian(state: FilterState, calibration: Calibration) -> Float:
    """(6, 22) of the predicted pose, in the tangent space of :func:`residual`, by the error state."""
    scale, R_VW = state.scale, state.R_WV.T
    p_AC = R_VW @ (state.p_WB + state.R_WB @ calibration.cameras[0].p_BC - state.p_WA)  # m, in the axes of V
    H = np.zeros((6, SIZE))
    H[0:3, DTHETA] = calibration.cameras[0].R_BC.T
    H[0:3, DTHETA_WV] = -(R_VW @ state.R_WB @ calibration.cameras[0].R_BC).T
    H[3:6, DTHETA] = -scale * R_VW @ state.R_WB @ so3.hat(calibration.cameras[0].p_BC)
    H[3:6, DP] = scale * R_VW
    H[3:6, LOG_SCALE] = scale * p_AC[:, None]
    H[3:6, DTHETA_WV] = scale * so3.hat(p_AC)
    H[3:6, DP_WA] = -scale * R_VW
    return H
