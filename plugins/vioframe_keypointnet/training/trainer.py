"""The trainer behind ``vioframe train keypointnet``: images in, a folder with checkpoint, log and weights out."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError
from vioframe.types import Image, TrainingJob, TrainingStep
from vioframe_keypointnet import weights
from vioframe_keypointnet.quantisation import measure_ranges
from vioframe_keypointnet.training.images import gather, split
from vioframe_keypointnet.training.loop import Training
from vioframe_keypointnet.training.options import TrainingOptions
from vioframe_keypointnet.training.validation import validate

_CALIBRATION_IMAGES = 64
"""Images on which the reach of each layer is measured for int8."""

CHECKPOINT, LOG, WEIGHTS = "checkpoint.pt", "log.csv", "keypointnet.safetensors"


class KeypointNetTrainer:
    """Trains a KeypointNet, or goes on training one."""

    def __init__(self, job: TrainingJob, options: TrainingOptions | None = None) -> None:
        options = options or TrainingOptions()
        self._job = job
        self._options = options
        checkpoint = job.out / CHECKPOINT
        if checkpoint.exists() and not job.resume:
            raise ConfigError(f"{job.out} holds a training already; go on with --resume or choose another --out")
        if job.resume and not checkpoint.exists():
            raise ConfigError(f"{checkpoint} does not exist, so there is nothing to resume; leave out --resume")
        pictures = gather(job.images, options.architecture.image_channels, options.frames_per_recording)
        train, held_out = split(pictures, job.hold_out)
        self._held_out = held_out[: options.validation_images]
        self._training = Training(options, train)
        self._counts = len(train), len(held_out)
        every = max(1, len(train) // _CALIBRATION_IMAGES)
        self._sample = [_grey(picture.pixels) for picture in train[::every][:_CALIBRATION_IMAGES]]
        self._history: list[Mapping[str, float]] = []
        if job.resume:
            self._history = self._training.resume(checkpoint)
        elif job.start_from is not None:
            self._training.start_from(weights.load(job.start_from).tensors)

    def train(self) -> Iterator[TrainingStep]:
        """Train to the end; however it ends, what is done stays in the checkpoint."""
        self._job.out.mkdir(parents=True, exist_ok=True)
        training, losses = self._training, []
        try:
            for values in training.steps():
                losses.append(values)
                summary: Mapping[str, float] | None = None
                if training.step % training.epoch_steps == 0:
                    summary = self._end_epoch(losses)
                    losses = []
                yield TrainingStep(training.step, training.total_steps, values, summary)
        finally:
            training.save(self._job.out / CHECKPOINT, self._history)
        self._write_weights()

    def _end_epoch(self, losses: list[Mapping[str, float]]) -> Mapping[str, float]:
        training = self._training
        row = {"epoch": training.step // training.epoch_steps}
        row |= {name: float(np.mean([values[name] for values in losses])) for name in losses[0]}
        if self._held_out:
            row |= asdict(validate(training.network, self._held_out, self._options.seed))
        self._history.append(row)
        training.save(self._job.out / CHECKPOINT, self._history)
        _write_csv(self._job.out / LOG, self._history)
        return row

    def _write_weights(self) -> None:
        options = self._options
        card = {
            "images": [path.name for path in self._job.images],
            "trained_on": self._counts[0],
            "held_out": self._counts[1],
            "started_from": None if self._job.start_from is None else Path(self._job.start_from).name,
            "options": asdict(options),
            "result": dict(self._history[-1]) if self._history else {},
        }
        tensors, architecture = self._training.tensors(), options.architecture
        ranges = measure_ranges(weights.Weights(architecture, tensors), self._sample)
        weights.save(self._job.out / WEIGHTS, tensors, architecture, card, ranges)


def _grey(pixels: NDArray[np.uint8]) -> Image:
    import cv2

    return pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)


def _write_csv(path: Path, rows: list[Mapping[str, float]]) -> None:
    part = path.with_name(f"{path.name}.part")
    with part.open("w", newline="", encoding="utf-8") as file:
        # Epochs of lessons have other losses than those that follow.
        writer = csv.DictWriter(file, list(dict.fromkeys(column for row in rows for column in row)))
        writer.writeheader()
        writer.writerows(rows)
    os.replace(part, path)
