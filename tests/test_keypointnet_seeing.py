"""What networks see on a CPU is what they saw in training, in floats and in 8 bits."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from keypointnet_helpers import COMPACT, FAR, NARROW, PEAKS, texture  # noqa: E402

from vioframe_keypointnet.network import locally_normalised  # noqa: E402
from vioframe_keypointnet.seeing import CONTRAST_STEP, ZERO, Eye  # noqa: E402


def in_training(architecture, image):
    contrast = locally_normalised(torch.from_numpy(image).float()[None, None] / 255.0)
    return torch.nn.functional.pixel_unshuffle(contrast, architecture.fold)[0].permute(1, 2, 0).numpy()


def half_dark(shape, seed=0):
    """Detail of all strengths down to none, and a border that the local means have to get along with."""
    image = texture(shape, seed).astype(float)
    return np.round(128 + (image - 128) * np.linspace(0.0, 2.0, shape[1])).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("architecture", [COMPACT, PEAKS, FAR], ids=lambda a: a.name)
def test_local_contrast_is_that_of_training(architecture):
    for shape in ((120, 160), (8, 8), (64, 24)):
        eye = Eye(architecture, shape, eight_bits=False)
        for image in (half_dark(shape), half_dark(shape, seed=1)):
            expected = in_training(architecture, image)
            eye(image)
            assert eye.seen.shape == expected.shape
            assert np.abs(eye.seen - expected).max() < 1e-4


@pytest.mark.parametrize("architecture", [COMPACT, FAR], ids=lambda a: a.name)
def test_eight_bits_are_the_nearest_step(architecture):
    for shape in ((120, 160), (64, 24)):
        eye = Eye(architecture, shape, eight_bits=True)
        for seed in (5, 1):
            image = half_dark(shape, seed)
            image[4, 5] = 255  # farther out than 8 bits reach
            expected = np.clip(in_training(architecture, image) / CONTRAST_STEP + ZERO, 0, 255)
            eye(image)
            assert eye.seen.dtype == np.uint8
            assert np.abs(eye.seen - expected).max() < 0.5 + 1e-3
            assert eye.seen.max() == 255


def test_a_published_network_sees_grey_levels():
    image = texture((16, 24))
    eye = Eye(NARROW, image.shape, eight_bits=True)
    eye(image)
    assert np.array_equal(eye.seen, image[..., None])
