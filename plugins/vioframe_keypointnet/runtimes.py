"""What runs the network: OpenVINO a graph of its own, the fastest on a CPU; torch the network as it was trained.

A runtime takes a grey image whose sides are multiples of 8 to what
:meth:`vioframe_keypointnet.network.KeypointNet.found` gives, without the batch's axis, in float32; it stays as it is
until the next call.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError, needs
from vioframe.types import Image
from vioframe_keypointnet.graph import model
from vioframe_keypointnet.options import Precision, Runtime
from vioframe_keypointnet.seeing import Eye
from vioframe_keypointnet.weights import Weights

Run = Callable[[Image], tuple[NDArray[np.float32], ...]]

PRECISIONS = {"cuda": ("float16", "float32"), "openvino": ("int8", "float32"), "torch": ("float32",)}
"""Runtimes and the precisions of each, the fastest first; ``cuda`` is torch on a GPU."""


def choose(runtime: Runtime, precision: Precision, calibrated: bool) -> tuple[str, str]:
    """Runtime and precision that the options mean here: where they leave it open, the fastest there is.

    ``calibrated`` says whether the weights have what int8 needs. Raises :class:`ConfigError` where there is no such
    combination.
    """
    if precision == "int8" and not calibrated:
        raise ConfigError(
            "these weights do not say the range of their activations, which int8 needs; have them measured: "
            "python -m vioframe_keypointnet IN OUT.safetensors --calibrate FOLDER_OF_IMAGES"
        )
    able = [r for r, has in PRECISIONS.items() if runtime in ("auto", r) and precision in ("auto", *has)]
    if not able:
        raise ConfigError(
            f"the runtime {runtime} has the precision {' or '.join(PRECISIONS[runtime])}, not {precision}"
        )
    # Where there is none, the error of the last says what to install.
    chosen = next((name for name in able if _is_here(name)), "openvino" if "openvino" in able else able[-1])
    if precision == "auto":
        return chosen, next(p for p in PRECISIONS[chosen] if p != "int8" or calibrated)
    return chosen, precision


def start(runtime: str, precision: str, weights: Weights, *, descriptors: bool, threads: int) -> Run:
    """The network of ``weights`` in ``runtime``, with so many ``threads``, or as many as the library likes if 0."""
    if runtime == "openvino":
        return _by_openvino(weights, descriptors, precision == "int8", threads)
    return _by_torch(weights, descriptors, "cuda" if runtime == "cuda" else "cpu", precision == "float16", threads)


def _by_openvino(weights: Weights, descriptors: bool, int8: bool, threads: int) -> Run:
    """OpenVINO's graph on a CPU, compiled for each size of image when the first comes."""
    with needs("openvino", "openvino", user="KeypointNet by OpenVINO"):
        import openvino

    core, see = openvino.Core(), Eye(weights.architecture, eight_bits=int8)
    settings: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
    if threads:
        settings["INFERENCE_NUM_THREADS"] = threads

    @lru_cache(maxsize=4)
    def compiled(shape: tuple[int, int]) -> Any:
        graph = model(weights, shape, descriptors=descriptors, int8=int8)
        return core.compile_model(graph, "CPU", settings).create_infer_request()

    def run(image: Image) -> tuple[NDArray[np.float32], ...]:
        request = compiled(cast(tuple[int, int], image.shape))
        found = request.infer({0: see(image)[None]}, share_inputs=True, share_outputs=True)
        return tuple(array[0] for array in found.to_tuple())

    return run


def _by_torch(weights: Weights, descriptors: bool, device: str, half: bool, threads: int) -> Run:
    """The network as it was trained; the number of threads, if given, is set for torch as a whole.

    With ``half`` the convolutions have half precision, and nothing else.
    """
    user = "KeypointNet by PyTorch"
    if device == "cpu":
        user += " (for a CPU -o runtime=openvino is enough, with vioframe[openvino],)"
    with needs("torch", "keypointnet", user=user):
        import torch

        from vioframe_keypointnet.network import of_weights
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("torch finds no CUDA device; leave -o runtime out, or install torch with CUDA")
    if threads:
        torch.set_num_threads(threads)
    network = of_weights(weights).to(device)

    def run(image: Image) -> tuple[NDArray[np.float32], ...]:
        # A copy: torch wants no memory that it may not write to.
        grey = torch.from_numpy(image.copy()).to(device)[None, None] / 255.0
        with torch.inference_mode(), torch.autocast(device, torch.float16, enabled=half):
            outputs = network.found(grey, descriptors=descriptors)
        return tuple(output[0].float().cpu().contiguous().numpy() for output in outputs)

    return run


def _is_here(runtime: str) -> bool:
    """Whether its libraries are installed; torch is loaded to ask it for a GPU only where there is a driver."""
    if runtime == "openvino":
        return find_spec("openvino") is not None
    if find_spec("torch") is None or (runtime == "cuda" and shutil.which("nvidia-smi") is None):
        return False
    if runtime == "torch":
        return True
    import torch

    return torch.cuda.is_available()
