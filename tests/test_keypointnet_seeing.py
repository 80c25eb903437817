"""What networks see on a CPU is what they saw in training, in floats and in 8 bits."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from keypointnet_helpers import COMPACT, FAR, NARROW, PEAKS, texture  # noqa: E402

from vioframe_keypointnet.network import locally_normalised  # noqa: E402
from vioframe_keypointnet.seeing import CONTRAST_STEP, ZERO, Eye  # noqa: E402


def in_training(architecture, image):
    contrast = locally_normalised(torch.from_numpy(image).float()[None, None] / 255.0)
    return torch.nn.functional.pixel_unshuffle(contrast, architecture.fold)[0].numpy()


def half_dark(shape, seed=0):
    """Detail of all strengths down to none, and a border that the local means have to get along with."""
    image = texture(shape, seed).astype(float)
    return np.round(128 + (image - 128) * np.linspace(0.0, 2.0, shape[1])).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("architecture", [COMPACT, PEAKS, FAR], ids=lambda a: a.name)
def test_local_contrast_is_that_of_training(architecture):
    eye = Eye(architecture, eight_bits=False)
    for shape in ((120, 160), (8, 8), (64, 24), (120, 160)):
        image = half_dark(shape)
        expected = in_training(architecture, image)
        found = eye(image)
        assert found.shape == expected.shape
        assert np.abs(found - expected).max() < 1e-4


@pytest.mark.parametrize("architecture", [COMPACT, FAR], ids=lambda a: a.name)
def test_eight_bits_are_the_nearest_step(architecture):
    eye = Eye(architecture, eight_bits=True)
    for shape in ((120, 160), (64, 24), (120, 160)):
        image = half_dark(shape, seed=1)
        image[4, 5] = 255  # farther out than 8 bits reach
        expected = np.clip(in_training(architecture, image) / CONTRAST_STEP + ZERO, 0, 255)
        found = eye(image)
        assert found.dtype == np.uint8
        assert np.abs(found - expected).max() < 0.5 + 1e-3
        assert found.max() == 255


def test_a_published_network_sees_grey_levels():
    image = texture((16, 24))
    assert np.array_equal(Eye(NARROW, eight_bits=True)(image), image[None])
