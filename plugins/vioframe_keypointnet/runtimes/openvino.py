"""OpenVINO: the fastest on CPUs, by far in int8."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Image
from vioframe_keypointnet.folding import FoldedNetwork
from vioframe_keypointnet.graph import onnx_model
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.seeing import Eye


class OpenVino:
    """Runs a network of one size of image at a time; ``hint`` is the precision of what is not in int8."""

    def __init__(self, network: FoldedNetwork, ranges: Mapping[str, float] | None, hint: str, threads: int) -> None:
        with needs("openvino", "openvino"):
            import openvino

        self._core = openvino.Core()
        self._network, self._ranges = network, ranges
        self._see = Eye(network.architecture, eight_bits=ranges is not None)
        self._settings: dict[str, Any] = {"INFERENCE_PRECISION_HINT": hint, "PERFORMANCE_HINT": "LATENCY"}
        if threads:
            self._settings["INFERENCE_NUM_THREADS"] = threads
        self._request = lru_cache(maxsize=4)(self._compile)

    def __call__(self, image: Image) -> tuple[NDArray[np.float32], ...]:
        request = self._request(cast(tuple[int, int], image.shape))
        found = request.infer({0: self._see(image)[None]}, share_inputs=True, share_outputs=True)
        return tuple(array[0] for array in found.to_tuple())

    def _compile(self, shape: tuple[int, int]) -> Any:
        model = self._core.read_model(onnx_model(self._network, shape, self._ranges))
        return self._core.compile_model(model, "CPU", self._settings).create_infer_request()
