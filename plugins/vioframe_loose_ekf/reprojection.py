"""One point in one camera: what resection and bundle adjustment are made of."""

from __future__ import annotations

import math

from vioframe.jit import kernel
from vioframe.types import Float

# A point nearer than this to the plane of the camera's centre cannot be seen.
_LEAST_DEPTH = 1e-3


@kernel
def reproject(R_VC: Float, p_VC: Float, p_VF: Float, xy: Float, sigma: float, e: Float, J: Float) -> bool:
    """Residual ``e`` (2,) on the z = 1 plane and its Jacobian ``J`` (2, 6) by the pose [dtheta dp], in sigma.

    Both are written in place; the Jacobian by the point is ``-J[:, 3:]``. False, and nothing written, where the point
    is behind the camera.
    """
    d0, d1, d2 = p_VF[0] - p_VC[0], p_VF[1] - p_VC[1], p_VF[2] - p_VC[2]
    q0 = R_VC[0, 0] * d0 + R_VC[1, 0] * d1 + R_VC[2, 0] * d2
    q1 = R_VC[0, 1] * d0 + R_VC[1, 1] * d1 + R_VC[2, 1] * d2
    q2 = R_VC[0, 2] * d0 + R_VC[1, 2] * d1 + R_VC[2, 2] * d2
    if q2 < _LEAST_DEPTH:
        return False
    x, y = q0 / q2, q1 / q2
    e[0], e[1] = (x - xy[0]) / sigma, (y - xy[1]) / sigma
    # q moves by [q]x dtheta - R^T dp; what that does on the plane is the first two rows of (1, 0, -x; 0, 1, -y) / z.
    unit = 1.0 / (q2 * sigma)
    J[0, 0], J[0, 1], J[0, 2] = x * q1 * unit, (-q2 - x * q0) * unit, q1 * unit
    J[1, 0], J[1, 1], J[1, 2] = (q2 + y * q1) * unit, -y * q0 * unit, -q0 * unit
    for k in range(3):
        J[0, 3 + k] = (x * R_VC[k, 2] - R_VC[k, 0]) * unit
        J[1, 3 + k] = (y * R_VC[k, 2] - R_VC[k, 1]) * unit
    return True


@kernel
def cauchy(squared: float, width: float) -> tuple[float, float]:
    """Cauchy's loss of a squared residual, half of it where it is small, and the weight that goes with it."""
    ratio = squared / (width * width)
    return 0.5 * width * width * math.log1p(ratio), 1.0 / (1.0 + ratio)
