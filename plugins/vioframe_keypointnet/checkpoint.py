"""Official KP2D checkpoints, ``{"state_dict": ..., "config": ...}``, without running any code they hold.

torch's own restricted loader admits tensors and plain containers and nothing else; the one class it is told of in
addition is the yacs ``CfgNode`` of ``config``, a dictionary, in whose place it puts one of Python's own.

    python -m vioframe_keypointnet.checkpoint v4.ckpt v4.safetensors --calibrate FOLDER_OF_IMAGES
"""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError

import click

from vioframe.errors import ConfigError, VioframeError
from vioframe.types import Image
from vioframe_keypointnet import weights as weights_file
from vioframe_keypointnet.architecture import FULL
from vioframe_keypointnet.optional import needs
from vioframe_keypointnet.weights import Weights

_MOST_IMAGES = 64


def read(path: Path) -> Weights:
    """The full network of an official checkpoint, in either of torch's formats.

    Raises :class:`ConfigError` where the file is none, wants anything but tensors built, or is of another network.
    """
    with needs("torch", "keypointnet"):
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
    read_weights = weights_file.of_tensors({name: t.numpy() for name, t in tensors.items()}, FULL, path)
    return replace(read_weights, card={"converted_from": path.name})


@click.command()
@click.argument("checkpoint", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--calibrate", type=click.Path(exists=True, file_okay=False, path_type=Path), help="Images for int8.")
def convert(checkpoint: Path, out: Path, calibrate: Path | None) -> None:
    """Write the weights in CHECKPOINT (.ckpt or .safetensors) to OUT (.safetensors).

    With --calibrate also what int8 inference needs to know, measured on up to 64 images of a folder.
    """
    try:
        found = weights_file.load(checkpoint)
        ranges = found.activation_ranges
        if calibrate is not None:
            from vioframe_keypointnet.quantisation import measure_ranges

            ranges = measure_ranges(found, _images(calibrate))
        weights_file.save(out, found.tensors, found.architecture, found.card, ranges)
    except VioframeError as error:
        raise click.ClickException(str(error)) from error


def _images(folder: Path) -> Iterator[Image]:
    """Up to 64 grey images of ``folder``, evenly from all it and its sub-folders hold."""
    import cv2
    import numpy as np

    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    for path in files[:: max(1, len(files) // _MOST_IMAGES)][:_MOST_IMAGES]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is not None:
            yield image.astype(np.uint8, copy=False)


if __name__ == "__main__":
    convert()
