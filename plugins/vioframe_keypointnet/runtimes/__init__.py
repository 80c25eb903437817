"""The libraries that run the network, and which of them is taken.

A runtime takes an image whose sides are multiples of 8 to what :meth:`FoldedNetwork.build` gives, without the batch's
axis: the heads (3, h, w) or the response, and, if the network describes, the descriptors (D, 2 h, 2 w). These are
float32 and stay as they are until the next call.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError
from vioframe.types import Image
from vioframe_keypointnet.folding import FoldedNetwork
from vioframe_keypointnet.options import Device, Precision, Runtime

Run = Callable[[Image], tuple[NDArray[np.float32], ...]]

ON_CPU = {"openvino": ("float32", "bfloat16", "int8"), "onnxruntime": ("float32", "int8"), "torch": ("float32",)}
"""Runtimes, the fastest first, and the precisions each has on a CPU."""

_NEED = {"openvino": ("openvino", "onnx"), "onnxruntime": ("onnxruntime", "onnx"), "torch": ("torch",)}

_ON_CUDA = ("float16", "float32")


def choose(runtime: Runtime, precision: Precision, device: Device, calibrated: bool) -> tuple[str, str, str]:
    """Runtime, precision and device that the options mean here: where they leave it open, the fastest installed.

    ``calibrated`` says whether the weights have what int8 needs. Raises :class:`ConfigError` where there is no such
    combination.
    """
    possible = runtime in ("auto", "torch") and precision in ("auto", *_ON_CUDA)
    if device == "cuda" or (device == "auto" and possible and _has_cuda()):
        if runtime not in ("auto", "torch"):
            raise ConfigError(f"on CUDA the runtime is torch, not {runtime}: leave the option runtime out")
        if precision != "auto" and precision not in _ON_CUDA:
            raise ConfigError(f"on CUDA the precision is {' or '.join(_ON_CUDA)}, not {precision}")
        return "torch", "float16" if precision == "auto" else precision, "cuda"
    if precision == "int8" and not calibrated:
        raise ConfigError(
            "these weights do not say the range of their activations, which int8 needs; have them measured: "
            "python -m vioframe_keypointnet.checkpoint IN OUT.safetensors --calibrate FOLDER_OF_IMAGES"
        )
    able = [name for name, has in ON_CPU.items() if precision in ("auto", *has)]
    chosen: str = runtime
    if runtime == "auto":
        if not able:
            raise ConfigError(f"no runtime has the precision {precision} on a CPU; leave the option precision out")
        chosen = next((name for name in able if all(map(find_spec, _NEED[name]))), able[0])
    if chosen not in able:
        raise ConfigError(f"on a CPU {chosen} has the precision {' or '.join(ON_CPU[chosen])}, not {precision}")
    if precision == "auto":
        return chosen, "int8" if calibrated and "int8" in ON_CPU[chosen] else "float32", "cpu"
    return chosen, precision, "cpu"


def on_cpu(
    runtime: str, precision: str, network: FoldedNetwork, ranges: Mapping[str, float] | None, threads: int
) -> Run:
    """``network`` in the library ``runtime``, with so many ``threads``, or as many as it likes if 0."""
    used = ranges if precision == "int8" else None
    if runtime == "openvino":
        from vioframe_keypointnet.runtimes.openvino import OpenVino

        return OpenVino(network, used, "bf16" if precision == "bfloat16" else "f32", threads)
    if runtime == "onnxruntime":
        from vioframe_keypointnet.runtimes.onnxruntime import OnnxRuntime

        return OnnxRuntime(network, used, threads)
    from vioframe_keypointnet.runtimes.torch import TorchOnCpu

    return TorchOnCpu(network, threads)


def _has_cuda() -> bool:
    """Whether torch could compute on a GPU; torch itself is asked, and loaded, only where there is a driver."""
    if find_spec("torch") is None or shutil.which("nvidia-smi") is None:
        return False
    import torch

    return torch.cuda.is_available()
