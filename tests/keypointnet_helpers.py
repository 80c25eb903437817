"""Small KeypointNets that were never trained but whose every number matters, and images to show them."""

import cv2
import numpy as np
import torch

from vioframe_keypointnet.architecture import COMPACT, FAR, FULL, Architecture
from vioframe_keypointnet.network import KeypointNet
from vioframe_keypointnet.weights import Weights

TINY = Architecture("tiny", 1, ((4,), (8,), (8,), (12, 8)), 16, 8)
COLOUR = Architecture("colour", 3, ((6,), (8,), (8,), (8,)), 8, 8)
PEAKS = Architecture("peaks", 3, ((), (8, 12), (16,), (8,)), 16, 8)
NARROW = FULL.widened(0.125)
ARCHITECTURES = {architecture.name: architecture for architecture in (TINY, COLOUR, PEAKS, NARROW, COMPACT, FAR)}


def network(architecture: Architecture, seed: int = 0) -> KeypointNet:
    """Ready to run; its batch norms know the textures below, and its heads say all they can."""
    torch.manual_seed(seed)
    net = KeypointNet(architecture, dropout=0.0)
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.momentum = None
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(0.0, 0.3)
        for last in (net.convDb, net.convR if architecture.peaks else net.convPb):
            last.weight.mul_(4.0)
        net.train()
        for number in range(4):
            net(torch.from_numpy(texture(seed=number)).float()[None, None] / 255.0)
    return net.eval()


def weights(net: KeypointNet) -> Weights:
    return Weights(
        net.architecture, {name: t.numpy() for name, t in net.state_dict().items() if t.dtype.is_floating_point}
    )


def texture(shape: tuple[int, int] = (120, 160), seed: int = 3) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 40 * smooth / max(smooth.std(), 1e-9), 0, 255).astype(np.uint8)
