"""onnxruntime, for where there is no OpenVINO."""

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

_WARNINGS_AND_LESS = 3


class OnnxRuntime:
    """Runs a network of one size of image at a time."""

    def __init__(self, network: FoldedNetwork, ranges: Mapping[str, float] | None, threads: int) -> None:
        with needs("onnxruntime", "onnxruntime"):
            import onnxruntime

        self._options = onnxruntime.SessionOptions()
        self._options.log_severity_level = _WARNINGS_AND_LESS
        self._options.intra_op_num_threads = threads
        self._network, self._ranges = network, ranges
        self._see = Eye(network.architecture, eight_bits=ranges is not None)
        self._session = lru_cache(maxsize=4)(self._load)

    def __call__(self, image: Image) -> tuple[NDArray[np.float32], ...]:
        found = self._session(cast(tuple[int, int], image.shape)).run(None, {"seen": self._see(image)[None]})
        return tuple(array[0] for array in found)

    def _load(self, shape: tuple[int, int]) -> Any:
        import onnxruntime

        model = onnx_model(self._network, shape, self._ranges)
        return onnxruntime.InferenceSession(model, self._options, ["CPUExecutionProvider"])
