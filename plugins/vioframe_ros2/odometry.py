"""Where the body is, as ROS 2 has it: nav_msgs/Odometry and a transform."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.geometry import so3
from vioframe.types import DBG, DP, DTHETA, DV, Float, ImuNoise, NavState
from vioframe_ros2.messages import ODOMETRY, TRANSFORMS, header, new


def odometry(state: NavState, gyro_B: Float, noise: ImuNoise, frame_id: str, child_frame_id: str) -> Any:
    """The body's pose in the frame ``frame_id``, which is W, and its velocity in its own, ``child_frame_id``.

    ``gyro_B`` (3,) rad/s is the reading that ``state`` reaches to. Without a covariance there are zeros, which say that
    it is not known.
    """
    v_B, omega_B = state.R_WB.T @ state.v_WB, gyro_B - state.bias_gyro_B
    pose = new("geometry_msgs/msg/Pose", position=_point("Point", state.p_WB), orientation=_quaternion(state.R_WB))
    twist = new("geometry_msgs/msg/Twist", linear=_point("Vector3", v_B), angular=_point("Vector3", omega_B))
    pose_cov, twist_cov = np.zeros((6, 6)), np.zeros((6, 6))
    if state.cov is not None:
        pose_cov, twist_cov = pose_covariance(state.R_WB, state.cov), twist_covariance(state, state.cov, noise)
    return new(
        ODOMETRY,
        header=header(state.t_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=pose_cov.ravel()),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=twist_cov.ravel()),
    )


def pose_covariance(R_WB: Float, cov: Float) -> Float:
    """Of position and rotation about the fixed axes of W, (6, 6) m and rad, from ``cov`` (15, 15) of a state.

    ``R_WB Exp(dtheta) = Exp(R_WB dtheta) R_WB``: the same rotation, about the axes of B and about those of W.
    """
    J = np.zeros((6, len(cov)))
    J[:3, DP] = np.eye(3)
    J[3:, DTHETA] = R_WB
    return _symmetric(J @ cov @ J.T)


def twist_covariance(state: NavState, cov: Float, noise: ImuNoise) -> Float:
    """Of velocity and angular rate, both along the axes of B, (6, 6) m/s and rad/s.

    ``v_B = Exp(-dtheta) R_WB^T (v_WB + dv)``; the rate is a reading without its bias, and has the noise of both.
    """
    J = np.zeros((6, len(cov)))
    J[:3, DTHETA] = so3.hat(state.R_WB.T @ state.v_WB)
    J[:3, DV] = state.R_WB.T
    J[3:, DBG] = -np.eye(3)
    out = J @ cov @ J.T
    out[3:, 3:] += noise.gyro_density**2 * noise.rate_hz * np.eye(3)
    return _symmetric(out)


def transform(t_ns: int, parent: str, child: str, R_PC: Float, p_PC: Float) -> Any:
    """A tf2_msgs/TFMessage with ``p_P = R_PC @ p_C + p_PC``."""
    moved = new("geometry_msgs/msg/Transform", translation=_point("Vector3", p_PC), rotation=_quaternion(R_PC))
    stamped = new(
        "geometry_msgs/msg/TransformStamped", header=header(t_ns, parent), child_frame_id=child, transform=moved
    )
    return new(TRANSFORMS, transforms=[stamped])


def _symmetric(M: Float) -> Float:
    return np.asarray(0.5 * (M + M.T))


def _point(kind: str, xyz: Float) -> Any:
    x, y, z = xyz.tolist()
    return new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _quaternion(R: Float) -> Any:
    x, y, z, w = so3.to_quat_xyzw(R).tolist()
    return new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
