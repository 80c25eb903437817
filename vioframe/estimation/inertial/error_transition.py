"""What the errors of an inertial state become over one interval between readings.

Of the 15 x 15 transition of [dtheta dp dv dbg dba] most is zero or one: only the first nine rows change anything, and
position changes with velocity by the length of the interval alone.
"""

from __future__ import annotations

from vioframe.arrays import Float
from vioframe.jit import kernel


@kernel
def move(dR: Float, by_theta: Float, by_biases: Float, h: float, M: Float) -> None:
    """``M`` (15, n) times the transition from the left, in place.

    dtheta becomes ``dR``' dtheta; ``by_theta`` (6, 3) is d [dp dv] / d dtheta and ``by_biases`` (9, 6) is
    d [dtheta dp dv] / d [dbg dba], of which that of dtheta by dba is zero; ``h`` s is the interval's length.
    """
    for j in range(M.shape[1]):
        x, y, z = M[0, j], M[1, j], M[2, j]
        u, v, w = M[9, j], M[10, j], M[11, j]
        a, b, c = M[12, j], M[13, j], M[14, j]
        for k in range(3):
            M[k, j] = (
                dR[0, k] * x + dR[1, k] * y + dR[2, k] * z
                + by_biases[k, 0] * u + by_biases[k, 1] * v + by_biases[k, 2] * w
            )  # fmt: skip
        for k in range(3, 9):
            M[k, j] += (
                by_theta[k - 3, 0] * x + by_theta[k - 3, 1] * y + by_theta[k - 3, 2] * z
                + by_biases[k, 0] * u + by_biases[k, 1] * v + by_biases[k, 2] * w
                + by_biases[k, 3] * a + by_biases[k, 4] * b + by_biases[k, 5] * c
            )  # fmt: skip
            if k < 6:
                M[k, j] += h * M[k + 3, j]


@kernel
def move_covariance(dR: Float, by_theta: Float, by_biases: Float, h: float, cov: Float) -> None:
    """``cov`` (15, 15) times the transition of :func:`move` from both sides, in place."""
    move(dR, by_theta, by_biases, h, cov)
    for i in range(15):
        for j in range(i):
            cov[i, j], cov[j, i] = cov[j, i], cov[i, j]
    move(dR, by_theta, by_biases, h, cov)


@kernel
def add_white(by: Float, variance: float, cov: Float) -> None:
    """Add ``by`` ``by``' ``variance``, of noise whose part in [dtheta dp dv] is ``by`` (9, 3), to ``cov`` (15, 15)."""
    for i in range(9):
        for j in range(9):
            cov[i, j] += variance * (by[i, 0] * by[j, 0] + by[i, 1] * by[j, 1] + by[i, 2] * by[j, 2])
