"""Smooth interpolation between densely sampled poses."""

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.geometry import so3
from vioframe.types import Float, Int

# Cubic interpolation needs two samples on either side.
_STENCIL = np.array([-1, 0, 1, 2])


def interpolate_poses(t_ns: Int, R_WB: Float, p_WB: Float, query_ns: Int) -> tuple[Float, Float]:
    """Poses at ``query_ns`` (M,) from samples at ``t_ns`` (N,): ``R_WB`` (M, 3, 3), ``p_WB`` (M, 3) m.

    Cubic Lagrange interpolation through the four nearest samples; rotations in the tangent space of the sample before
    the query, so that the error is of fourth order in the sampling interval for both (a geodesic's would be of second
    order: 0.1 px of image motion at the angular accelerations of a fast flight sampled at 200 Hz).

    Raises :class:`TrajectoryError` where a query lies outside the samples.
    """
    if len(t_ns) < len(_STENCIL):
        raise TrajectoryError(f"cannot interpolate {len(t_ns)} poses; at least {len(_STENCIL)} are needed")
    if len(query_ns) and (query_ns.min() < t_ns[0] or query_ns.max() > t_ns[-1]):
        raise TrajectoryError("a pose was asked for outside the ground truth; limit the frames to the stamps it covers")
    before = np.searchsorted(t_ns, query_ns, side="right") - 1
    stencil = np.clip(before, 1, len(t_ns) - 3)[:, None] + _STENCIL  # (M, 4)
    weights = _lagrange_weights((t_ns[stencil] - query_ns[:, None]) * 1e-9)
    R_anchor = R_WB[stencil[:, 1]]
    phi = so3.log(np.swapaxes(R_anchor, -1, -2)[:, None] @ R_WB[stencil])
    R = R_anchor @ so3.exp(np.einsum("mk,mki->mi", weights, phi))
    return R, np.einsum("mk,mki->mi", weights, p_WB[stencil])


def _lagrange_weights(nodes: Float) -> Float:
    """Weights (M, K) of the samples at ``nodes`` (M, K) for the value of their polynomial at zero."""
    count = nodes.shape[1]
    weights = np.ones_like(nodes)
    for k in range(count):
        for j in range(count):
            if j != k:
                weights[:, k] *= nodes[:, j] / (nodes[:, j] - nodes[:, k])
    return weights
