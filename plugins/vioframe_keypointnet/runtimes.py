"""What runs the network: OpenVINO a graph of its own, the fastest on a CPU; torch the network as it was trained.

A runtime takes a grey image whose sides are multiples of 8 to what
:meth:`vioframe_keypointnet.network.KeypointNet.found` gives, without the batch's axis, in float32; it stays as it is
until the next call. By CUDA what the published network gives are its candidates,
:func:`vioframe_keypointnet.network.strongest`.
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
from vioframe_keypointnet.graph import import_openvino, model
from vioframe_keypointnet.options import KeypointNetOptions, Precision, Runtime
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


def start(runtime: str, precision: str, weights: Weights, options: KeypointNetOptions) -> Run:
    """The network of ``weights`` in ``runtime``. Raises :class:`ConfigError` where that is not to be had."""
    if options.compiled and runtime != "cuda":
        raise ConfigError(f"-o compiled is of runtime=cuda, and the network runs by {runtime}; leave it out")
    if runtime == "openvino":
        return _by_openvino(weights, options.descriptors, precision == "int8", options.threads)
    if runtime == "cuda":
        return _by_cuda(weights, precision == "float16", options)
    return _by_torch(weights, options.descriptors, options.threads)


def _by_openvino(weights: Weights, descriptors: bool, int8: bool, threads: int) -> Run:
    """OpenVINO's graph on a CPU, compiled for each size of image when the first comes."""
    openvino = import_openvino()
    core = openvino.Core()
    settings: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
    # It would wait for one core while the back-end is on that, though the other is free.
    settings["ENABLE_CPU_PINNING"] = False
    # A small network is through before a second thread would pay, and the other core has a back-end to run.
    if threads := threads or int(weights.architecture.peaks):
        settings["INFERENCE_NUM_THREADS"] = threads

    @lru_cache(maxsize=4)
    def compiled(shape: tuple[int, int]) -> tuple[Eye, Any, tuple[NDArray[np.float32], ...]]:
        """What sees, the network, and what that gives, each of which finds what the one before leaves."""
        eye = Eye(weights.architecture, shape, eight_bits=int8)
        graph = model(weights, shape, descriptors=descriptors, int8=int8)
        request = core.compile_model(graph, "CPU", settings).create_infer_request()
        request.set_input_tensor(openvino.Tensor(eye.seen[None], shared_memory=True))
        return eye, request, tuple(tensor.data[0] for tensor in request.output_tensors)

    def run(image: Image) -> tuple[NDArray[np.float32], ...]:
        see, request, outputs = compiled(cast(tuple[int, int], image.shape))
        see(image)
        request.infer(share_outputs=True)
        return outputs

    return run


def _by_torch(weights: Weights, descriptors: bool, threads: int) -> Run:
    """The network as it was trained, on a CPU; the number of threads, if given, is set for torch as a whole."""
    user = "KeypointNet by PyTorch (for a CPU -o runtime=openvino is enough, with vioframe[openvino],)"
    with needs("torch", "keypointnet", user=user):
        import torch

        from vioframe_keypointnet.network import of_weights
    if threads:
        torch.set_num_threads(threads)
    network = of_weights(weights)

    def run(image: Image) -> tuple[NDArray[np.float32], ...]:
        # A copy: torch wants no memory that it may not write to.
        grey = torch.from_numpy(image.copy())[None, None] / 255.0
        with torch.inference_mode():
            outputs = network.found(grey, descriptors=descriptors)
        return tuple(output[0].contiguous().numpy() for output in outputs)

    return run


def _by_cuda(weights: Weights, half: bool, options: KeypointNetOptions) -> Run:
    """The same on a GPU, from the image in to the outputs back one CUDA graph, captured for each size of image when the
    first comes: to launch it costs the same however many layers there are.

    With ``half`` the convolutions have half precision, and nothing else. Raises :class:`ConfigError` where it should be
    compiled and cannot be.
    """
    with needs("torch", "keypointnet", user="KeypointNet by PyTorch"):
        import torch

        from vioframe_keypointnet.network import of_weights, strongest
    if not torch.cuda.is_available():
        raise ConfigError("torch finds no CUDA device; leave -o runtime out, or install torch with CUDA")
    network = of_weights(weights).to("cuda", torch.float16 if half else torch.float32)

    @lru_cache(maxsize=4)
    def captured(shape: tuple[int, int]) -> tuple[torch.cuda.CUDAGraph, Image, list[NDArray[np.float32]]]:
        """The graph, the array that it takes the image from, and those it leaves the outputs in."""
        image = torch.empty(shape, dtype=torch.uint8, pin_memory=True)

        def found(grey: torch.Tensor) -> list[torch.Tensor]:
            first, *more = (output[0] for output in network.found(grey, descriptors=options.descriptors))
            if not weights.architecture.peaks:
                first = strongest(first, options.nms_px)
            return [output.contiguous() for output in (first, *more)]

        def work() -> list[torch.Tensor]:
            return find(image.to("cuda", non_blocking=True)[None, None] / 255.0)

        find = torch.compile(found, dynamic=False) if options.compiled else found

        aside, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()  # type: ignore[no-untyped-call]
        # In full precision TF32 would round to ten bits. To try cuDNN's algorithms one after the other gains nothing.
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=half):
            with torch.cuda.stream(aside):
                try:
                    for _ in range(3):
                        warm = work()
                except RuntimeError as error:
                    if not options.compiled:
                        raise
                    first = str(error).strip().partition("\n")[0]
                    raise ConfigError(
                        f"torch.compile failed ({first}); it needs a C compiler, as gcc; or leave -o compiled out"
                    ) from error
            aside.synchronize()
            outputs = [torch.empty(output.shape, pin_memory=True) for output in warm]
            with torch.cuda.graph(graph, stream=aside, capture_error_mode="thread_local"):
                for output, made in zip(outputs, work(), strict=True):
                    output.copy_(made, non_blocking=True)
        return graph, image.numpy(), [output.numpy() for output in outputs]

    def run(image: Image) -> tuple[NDArray[np.float32], ...]:
        graph, seen, outputs = captured(cast(tuple[int, int], image.shape))
        seen[:] = image
        graph.replay()
        torch.cuda.current_stream().synchronize()
        return tuple(outputs)

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
