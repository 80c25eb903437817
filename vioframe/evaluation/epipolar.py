"""How well feature tracks obey the epipolar geometry of the true motion: the front-end judged without a back-end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vioframe.geometry.trajectory import Trajectory
from vioframe.geometry.two_view import essential_matrix, sampson_distance
from vioframe.types import Calibration, Float, FrameTracks


def epipolar_errors_px(
    steps: Sequence[FrameTracks], ground_truth: Trajectory, calibration: Calibration, baseline: int
) -> Float:
    """(N,) distances of all points seen both in one frame and ``baseline`` frames later, in pixels of one view.

    Frames that the ground truth does not cover are left out. Its own error, of a pixel or so over ten frames of EuRoC,
    is part of what is measured: compare front-ends by it, do not read it as noise.
    """
    covered = [s for s in steps if ground_truth.covers([s.t_ns])[0]]
    truth = ground_truth.at([s.t_ns for s in covered])
    R_WC, p_WC = calibration.cameras[0].pose(truth.R_WB, truth.p_WB)
    errors = [np.empty(0)]
    for k in range(len(covered) - baseline):
        before, after = covered[k], covered[k + baseline]
        _, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
        R_C2W = R_WC[k + baseline].T
        E = essential_matrix(R_C2W @ R_WC[k], R_C2W @ (p_WC[k] - p_WC[k + baseline]))
        errors.append(np.abs(sampson_distance(E, before.xy_normalised[i], after.xy_normalised[j])))
    # Sampson's distance shares an error evenly between two views; the root of two puts all of it into one.
    error_px: Float = np.sqrt(2.0) * calibration.cameras[0].model.focal_px * np.concatenate(errors)
    return error_px
