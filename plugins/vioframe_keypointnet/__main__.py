"""Converts weights once, so that they load without torch and run in int8.

python -m vioframe_keypointnet v4.ckpt v4.safetensors --calibrate FOLDER_OF_IMAGES
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from vioframe.bench.detectors.images import evenly, find_images, read_grey
from vioframe.errors import VioframeError
from vioframe_keypointnet import weights as weights_file

_MOST_IMAGES = 64


@click.command()
@click.argument("checkpoint", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--calibrate", type=click.Path(exists=True, file_okay=False, path_type=Path), help="Images for int8.")
@click.option("--eight-bits", is_flag=True, help="Round convolutions to 8 bits.")
def convert(checkpoint: Path, out: Path, calibrate: Path | None, eight_bits: bool) -> None:
    """Write the weights in CHECKPOINT (.ckpt or .safetensors) to OUT (.safetensors).

    With --calibrate also what int8 inference needs to know, measured on up to 64 images of a folder; with --eight-bits
    in a quarter of the size.
    """
    try:
        found = weights_file.load(checkpoint)
        if calibrate is not None:
            from vioframe_keypointnet.quantisation import measure_ranges

            ranges = measure_ranges(found, map(read_grey, evenly(find_images(calibrate), _MOST_IMAGES)))
            found = replace(found, activation_ranges=ranges)
        weights_file.save(out, found, eight_bits=eight_bits)
    except VioframeError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    convert()
