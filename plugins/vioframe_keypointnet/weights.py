"""Trained weights: one ``.safetensors`` file that also says which network it is of, and how it was trained.

The metadata holds ``architecture``, a ``card`` (free JSON: data, schedule, figures) and, for int8 inference,
``activation_ranges``, so that nobody who only runs the network needs images to calibrate it.

Official checkpoints of KP2D, ``{"state_dict": ..., "config": ...}``, are read too, without running any code they hold:
torch's own restricted loader admits tensors and plain containers and nothing else; the one class it is told of in
addition is the yacs ``CfgNode`` of ``config``, a dictionary, in whose place it puts one of Python's own.
"""

from __future__ import annotations

import json
import logging
import re
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError, needs
from vioframe.parts.options import did_you_mean
from vioframe_keypointnet.architecture import ARCHITECTURES, FULL, Architecture, Tensors

_LOG = logging.getLogger(__name__)

_SHIPPED = Path(__file__).parent / "data"
_PREFIX, _SUFFIX = "keypointnet-", ".safetensors"
_UNTRAINED = "untrained:"
_STEPS = ".steps"
"""Behind the name of a tensor of int8: how much one is worth, a channel."""
_REMEDY = (
    "train some with `vioframe train keypointnet --images DIR`, or name an official checkpoint: -o weights=v4.ckpt"
)


@dataclass(frozen=True, slots=True)
class Weights:
    """A network's tensors (float32, read-only by convention) and what is known of them.

    ``activation_ranges`` maps the name of a folded layer to the largest output that int8 inference represents; None
    where they have not been measured, see :mod:`vioframe_keypointnet.quantisation`.
    """

    architecture: Architecture
    tensors: Tensors
    card: Mapping[str, Any] = field(default_factory=dict)
    activation_ranges: Mapping[str, float] | None = None

    @property
    def target(self) -> str:
        """What the detector was trained for: repeatability, or what becomes of points that are followed."""
        return str(self.card.get("target", "repeatability"))

    @property
    def view_side_px(self) -> int:
        """The shorter side of the views in training; where the card does not say, that of the weights that ship."""
        return int(min(self.card.get("options", {}).get("size", (320, 240))))

    @property
    def has_descriptors(self) -> bool:
        """Whether the layers of descriptors were trained with those before them, as these are."""
        return bool(self.card.get("descriptors", True))


def save(path: Path, weights: Weights, *, eight_bits: bool = False) -> None:
    """Write ``weights`` as a file that :func:`load` reads, but for counters of batches.

    In ``eight_bits`` convolutions are rounded to 127 steps either way, one size of step for each channel that they
    give: a quarter of the size. Raises :class:`ConfigError` where the tensors are not those of the architecture.
    """
    with needs("safetensors", "openvino", user="KeypointNet"):
        from safetensors.numpy import save_file

    checked = _checked(weights.tensors, weights.architecture, "the tensors to save")
    metadata = {"architecture": weights.architecture.to_json(), "card": json.dumps(dict(weights.card))}
    if weights.activation_ranges is not None:
        metadata["activation_ranges"] = json.dumps(dict(weights.activation_ranges))
    save_file(dict(_rounded(checked) if eight_bits else checked), path, metadata)


def load(source: str | Path) -> Weights:
    """Weights by the name of those that ship, or from a ``.safetensors`` file or an official ``.ckpt``.

    ``untrained:full`` and the like are random, for measuring speed: only ever by this explicit wish.
    Raises :class:`ConfigError` saying how to get weights.
    """
    name = str(source)
    if name.startswith(_UNTRAINED):
        return _random(name)
    path = Path(source).expanduser()
    if not path.is_file():
        path = _SHIPPED / f"{_PREFIX}{name}{_SUFFIX}"
    if not path.is_file():
        known = shipped()
        raise ConfigError(
            f"there are no KeypointNet weights {name!r}{did_you_mean(name, known)}: neither a file nor among those "
            f"that ship ({', '.join(known) or 'none'}); {_REMEDY}"
        )
    return _read(path) if path.suffix == _SUFFIX else _read_checkpoint(path)


def shipped() -> list[str]:
    """Names of the weights that came with the package."""
    return sorted(path.name[len(_PREFIX) : -len(_SUFFIX)] for path in _SHIPPED.glob(f"{_PREFIX}*{_SUFFIX}"))


def _read(path: Path) -> Weights:
    with needs("safetensors", "openvino", user="KeypointNet"):
        from safetensors import SafetensorError, safe_open
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            tensors = _whole({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118, it is no mapping
    except (SafetensorError, OSError, ValueError, LookupError) as error:
        raise ConfigError(f"{path} is damaged or no safetensors file ({error}); {_REMEDY}") from error
    try:
        architecture = Architecture.from_json(metadata["architecture"])
        card = dict(json.loads(metadata.get("card", "{}")))
        ranges = json.loads(metadata.get("activation_ranges", "null"))
        ranges = None if ranges is None else {str(layer): float(most) for layer, most in ranges.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(
            f"{path} does not say which KeypointNet it is of; convert official checkpoints with "
            f"`python -m vioframe_keypointnet IN.ckpt OUT.safetensors`, or {_REMEDY}"
        ) from error
    return Weights(architecture, _checked(tensors, architecture, str(path)), card, ranges)


def _rounded(tensors: Tensors) -> dict[str, NDArray[Any]]:
    """Convolutions as int8, and the step of each channel beside them."""
    rounded: dict[str, NDArray[Any]] = dict(tensors)
    for name, values in tensors.items():
        if values.ndim == 4:
            steps = np.maximum(np.abs(values).max(axis=(1, 2, 3)) / 127.0, np.finfo(np.float32).tiny)
            rounded[name] = np.round(values / steps[:, None, None, None]).astype(np.int8)
            rounded[name + _STEPS] = steps.astype(np.float32)
    return rounded


def _whole(tensors: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The same in float32 again; other ``tensors`` as they are."""
    for name in [name for name in tensors if name.endswith(_STEPS)]:
        tensors[name.removesuffix(_STEPS)] = tensors[name.removesuffix(_STEPS)] * tensors.pop(name)[:, None, None, None]
    return tensors


def _read_checkpoint(path: Path) -> Weights:
    """The full network of an official checkpoint, in either of torch's formats.

    Raises :class:`ConfigError` where the file is none, wants anything but tensors built, or is of another network.
    """
    with needs("torch", "keypointnet", user="an official checkpoint"):
        import torch
    try:
        with torch.serialization.safe_globals([(OrderedDict, "yacs.config.CfgNode")]):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        forbidden = re.search(r"GLOBAL (\S+)", str(error))
        what = f"wants {forbidden[1]} loaded, which no checkpoint needs" if forbidden else "is damaged or no checkpoint"
        raise ConfigError(f"{path} {what}; get the file anew from its authors") from error
    except (RuntimeError, EOFError, ValueError, KeyError, AttributeError, OSError) as error:
        raise ConfigError(f"{path} is damaged or no checkpoint of torch; get the file anew from its authors") from error
    tensors = content.get("state_dict") if isinstance(content, Mapping) else None
    if not isinstance(tensors, Mapping) or not all(isinstance(t, torch.Tensor) for t in tensors.values()):
        raise ConfigError(f"{path} is no checkpoint of KP2D: it has no tensors under 'state_dict'")
    arrays = _checked({name: t.numpy() for name, t in tensors.items()}, FULL, str(path))
    return Weights(FULL, arrays, {"converted_from": path.name})


def _random(name: str) -> Weights:
    kind = name.removeprefix(_UNTRAINED)
    if kind not in ARCHITECTURES:
        raise ConfigError(f"there is no network {kind!r} to leave untrained; known: {', '.join(sorted(ARCHITECTURES))}")
    _LOG.warning("KeypointNet runs with random weights, as asked: it is good for measuring speed and nothing else")
    architecture, rng, tensors = ARCHITECTURES[kind], np.random.default_rng(0), {}
    for tensor, shape in architecture.shapes.items():
        if len(shape) == 4:
            # Under which signals neither grow nor fade (He et al., ICCV 2015).
            tensors[tensor] = rng.normal(0.0, np.sqrt(2.0 / np.prod(shape[1:])), shape).astype(np.float32)
        else:
            tensors[tensor] = np.full(shape, tensor.endswith((".1.weight", "running_var")), np.float32)
    ranges = dict.fromkeys(architecture.ranged, 1.0)  # signals stay about as small as the normalised image
    return Weights(architecture, tensors, {"trained": False}, ranges)


def _checked(tensors: Mapping[str, Any], architecture: Architecture, what: str) -> Tensors:
    """``tensors`` as float32, exactly those that ``architecture`` has."""
    expected = architecture.shapes
    found = {name: tuple(t.shape) for name, t in tensors.items() if not name.endswith("num_batches_tracked")}
    wrong = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    if wrong:
        have, want = (f"{shape}" if shape else "nothing" for shape in (found.get(wrong[0]), expected.get(wrong[0])))
        more = f" and {len(wrong) - 1} more such" if len(wrong) > 1 else ""
        raise ConfigError(
            f"{what}: not the weights of a {architecture.name} KeypointNet: "
            f"{wrong[0]} has the shape {have} and not {want}{more}; {_REMEDY}"
        )
    arrays = {name: np.ascontiguousarray(tensors[name], np.float32) for name in expected}
    broken = [name for name, array in arrays.items() if not np.isfinite(array).all()]
    if broken:
        raise ConfigError(f"{what}: {broken[0]} holds numbers that are not finite; {_REMEDY}")
    return arrays
