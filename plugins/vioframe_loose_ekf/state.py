"""What the filter estimates: the body, and the vision frame's scale and place in the world; and what follows from it.

V is the frame of the visual odometry: right in shape, but of unknown scale, orientation and position. Its map is new
at one end and gone at the other, so what V is drifts; it is therefore tied to the world at an *anchor*, a point
``p_VA`` of V near the camera, rather than at its origin, which may lie a hundred metres back.

What the visual odometry should say of the camera is eq. (13)-(14) of Weiss et al. (2012), with the anchor in place of
V's origin and the error of the rotation on the right:

    p_VC = p_VA + lambda R_WV^T (p_WB + R_WB p_BC - p_WA)
    R_VC = R_WV^T R_WB R_BC
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, DV, CameraOnBody, Float, NavState

# The error state: [dtheta dp dv dbg dba] of the body, then what ties V to W.
IMU = 15
LOG_SCALE = slice(15, 16)
DTHETA_WV = slice(16, 19)
DP_WA = slice(19, 22)
SIZE = 22


@dataclass(frozen=True, slots=True)
class VisionPose:
    """Pose of the camera in V: ``R_VC`` (3, 3) and ``p_VC`` (3,) in V's units."""

    R_VC: Float
    p_VC: Float

    def beyond(self, other: VisionPose) -> Float:
        """(6,) [rotation, position] from ``other`` to this; the rotation in the axes of the other camera, rad."""
        return np.concatenate([so3.log(other.R_VC.T @ self.R_VC), self.p_VC - other.p_VC])


@dataclass(frozen=True, slots=True)
class FilterState:
    """The mean. ``exp(log_scale)`` is the length in V of one metre (lambda in Weiss et al.).

    ``R_WV`` (3, 3) turns V into W, ``p_WA`` (3,) m is where the anchor is in W, ``p_VA`` (3,) where it is in V,
    which is chosen and therefore exact. Rotations are perturbed on the right, all else is additive.
    """

    R_WB: Float
    p_WB: Float
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float
    log_scale: float
    R_WV: Float
    p_WA: Float
    p_VA: Float

    @classmethod
    def begin(cls, nav: NavState) -> FilterState:
        """At ``nav``; V is W until an image says where it is."""
        return cls(
            nav.R_WB, nav.p_WB, nav.v_WB, nav.bias_gyro_B, nav.bias_accel_B, 0.0, np.eye(3), np.zeros(3), np.zeros(3)
        )

    @property
    def scale(self) -> float:
        """Units of V a metre."""
        return float(np.exp(self.log_scale))

    def retract(self, dx: Float) -> FilterState:
        """Moved by the error ``dx`` (22,)."""
        return replace(
            self,
            R_WB=self.R_WB @ so3.exp(dx[DTHETA]),
            p_WB=self.p_WB + dx[DP],
            v_WB=self.v_WB + dx[DV],
            bias_gyro_B=self.bias_gyro_B + dx[DBG],
            bias_accel_B=self.bias_accel_B + dx[DBA],
            log_scale=self.log_scale + float(dx[LOG_SCALE][0]),
            R_WV=self.R_WV @ so3.exp(dx[DTHETA_WV]),
            p_WA=self.p_WA + dx[DP_WA],
        )

    def in_world(self, p_V: Float) -> Float:
        """Points (N, 3) of V in W, m."""
        return self.p_WA + (p_V - self.p_VA) @ self.R_WV.T / self.scale

    def pose(self, camera: CameraOnBody) -> VisionPose:
        """Of ``camera`` in V."""
        p_WC = self.p_WB + self.R_WB @ camera.p_BC
        R_VB = self.R_WV.T @ self.R_WB
        return VisionPose(R_VB @ camera.R_BC, self.p_VA + self.scale * self.R_WV.T @ (p_WC - self.p_WA))

    def pose_jacobian(self, camera: CameraOnBody) -> Float:
        """(6, 22) of :meth:`pose`, in the tangent space of :meth:`VisionPose.beyond`, by the error state."""
        scale, R_VW = self.scale, self.R_WV.T
        p_AC = R_VW @ (self.p_WB + self.R_WB @ camera.p_BC - self.p_WA)  # m, in the axes of V
        H = np.zeros((6, SIZE))
        H[0:3, DTHETA] = camera.R_BC.T
        H[0:3, DTHETA_WV] = -(R_VW @ self.R_WB @ camera.R_BC).T
        H[3:6, DTHETA] = -scale * R_VW @ self.R_WB @ so3.hat(camera.p_BC)
        H[3:6, DP] = scale * R_VW
        H[3:6, LOG_SCALE] = scale * p_AC[:, None]
        H[3:6, DTHETA_WV] = scale * so3.hat(p_AC)
        H[3:6, DP_WA] = -scale * R_VW
        return H
