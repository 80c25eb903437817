"""What is known of cameras that sit on one rig."""

from dataclasses import replace

import numpy as np
from msckf_helpers import CALIBRATION, STEREO, prior_of

from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE as SIZE
from vioframe.estimation.rig import covariance
from vioframe.geometry import so3


def test_one_camera_is_as_it_is_given():
    prior = prior_of(CALIBRATION)
    np.testing.assert_array_equal(covariance(prior), np.diag(prior.sigma[0].stacked() ** 2))


def test_each_camera_is_known_as_the_first_and_both_beside_each_other_much_better():
    prior = prior_of(STEREO)
    cov, sigma = covariance(prior), prior.sigma[0].stacked()
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), np.tile(sigma, 2), rtol=1e-12)
    left, right = STEREO.cameras
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(2 * SIZE), cov, 4000, method="eigh")
    one, other = errors[:, :SIZE], errors[:, SIZE:]
    given = left.R_BC.T @ right.R_BC
    turned = [
        so3.log(given.T @ so3.exp(-a) @ given @ so3.exp(b)) for a, b in zip(one[:, :3], other[:, :3], strict=True)
    ]
    np.testing.assert_allclose(np.std(turned, axis=0), np.sqrt(2.0) * 0.001, rtol=0.05)
    np.testing.assert_allclose(np.std(one[:, 3:6] - other[:, 3:6], axis=0), np.sqrt(2.0) * 0.001, rtol=0.05)
    np.testing.assert_allclose(np.std(one[:, 6] - other[:, 6]), np.sqrt(2.0) * 0.001, rtol=0.05)
    assert np.abs(np.corrcoef(one[:, 8], other[:, 8])[0, 1]) < 0.1


def test_what_is_known_for_sure_of_the_first_camera_is_known_for_sure_of_all():
    prior = prior_of(STEREO)
    sure = replace(prior, sigma=(replace(prior.sigma[0], position=np.zeros(3)), prior.sigma[1]))
    variances = np.diag(covariance(sure)).reshape(2, SIZE)
    assert (variances[:, 3:6] == 0.0).all()
    assert (variances[:, :3] > 0.0).all()
