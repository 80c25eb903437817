"""The trainer behind ``vioframe train keypointnet``: images in, a folder with checkpoint, log and weights out.

A step depends on nothing but its number, and the checkpoint holds all that the next one needs.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn import Module
from torch.optim import Adam
from torch.utils.data import DataLoader, Dataset

from vioframe.bench.detectors.images import random_homography
from vioframe.bench.detectors.metrics import score_pair
from vioframe.errors import ConfigError
from vioframe.types import TrainingJob, TrainingStep
from vioframe_keypointnet import weights
from vioframe_keypointnet.detector import KeypointNet as Detector
from vioframe_keypointnet.network import KeypointNet, fill, in_channels_last, of_weights
from vioframe_keypointnet.options import KeypointNetOptions, Runtime, TrainingOptions
from vioframe_keypointnet.quantisation import measure_ranges
from vioframe_keypointnet.training.followed import Followed, Told, follow, followed_losses, rank_correlation, told
from vioframe_keypointnet.training.losses import InlierOutlierNet, losses, matching_loss, teach
from vioframe_keypointnet.training.samples import Pair, Picture, batch, gather, simulated_worlds, split

CHECKPOINT, LOG, WEIGHTS = "checkpoint.pt", "log.csv", "keypointnet.safetensors"

_CALIBRATION_IMAGES = 64
"""Images on which the reach of each layer is measured for int8."""
_VALIDATION_IMAGES = 50
"""At most so many of the images held out are looked at after each epoch."""
_VALIDATION_SIZE, _VALIDATION_TOP = (320, 240), 300
_LOSS_WEIGHTS = {"descriptor": 2.0}
"""As published; the other losses have weight one."""

_FREE = frozenset({"epochs", "device", "threads", "workers"})
"""What may be chosen anew when a training goes on."""


class KeypointNetTrainer:
    """Trains a KeypointNet, or goes on training one."""

    def __init__(self, job: TrainingJob, options: TrainingOptions) -> None:
        self._job = job
        self._options = options
        checkpoint = job.out / CHECKPOINT
        if checkpoint.exists() and not job.resume:
            raise ConfigError(f"{job.out} holds a training already; go on with --resume or choose another --out")
        if job.resume and not checkpoint.exists():
            raise ConfigError(f"{checkpoint} does not exist, so there is nothing to resume; leave out --resume")
        worlds = simulated_worlds(job.images)
        pictures: list[Picture]
        if options.target == "repeatability":
            pictures = gather(job.images, options.frames_per_recording)
        else:
            pictures = [followed for recording in job.images for followed in follow(recording)]
        train, held_out = split(pictures, job.hold_out)
        self._held_out = held_out[:_VALIDATION_IMAGES]
        self._training = Training(options, train)
        self._counts = len(train), len(held_out)
        every = max(1, len(train) // _CALIBRATION_IMAGES)
        self._sample = train[::every][:_CALIBRATION_IMAGES]
        self._history: list[Mapping[str, float]] = []
        if job.resume:
            self._history = self._training.resume(checkpoint)
        elif job.start_from is not None:
            self._training.start_from(weights.load(job.start_from))
        self._training.saw(worlds)

    def train(self) -> Iterator[TrainingStep]:
        """Train to the end; however it ends, what is done stays in the checkpoint."""
        self._job.out.mkdir(parents=True, exist_ok=True)
        training, of_epoch = self._training, []
        try:
            for values in training.steps():
                of_epoch.append(values)
                summary: Mapping[str, float] | None = None
                if training.step % training.epoch_steps == 0:
                    summary = self._end_epoch(of_epoch)
                    of_epoch = []
                yield TrainingStep(training.step, training.total_steps, values, summary)
        finally:
            training.save(self._job.out / CHECKPOINT, self._history)
        self._write_weights()

    def _end_epoch(self, of_epoch: list[Mapping[str, float]]) -> Mapping[str, float]:
        training = self._training
        row: dict[str, float] = {"epoch": training.step // training.epoch_steps}
        row |= {name: float(np.mean([values[name] for values in of_epoch])) for name in of_epoch[0]}
        if self._held_out:
            row |= training.validate(self._held_out)
        self._history.append(row)
        training.save(self._job.out / CHECKPOINT, self._history)
        # Epochs of lessons have other losses than those that follow.
        pd.DataFrame(self._history).to_csv(self._job.out / LOG, index=False)
        return row

    def _write_weights(self) -> None:
        about = {
            "images": [path.name for path in self._job.images],
            "trained_on": self._counts[0],
            "held_out": self._counts[1],
            "started_from": None if self._job.start_from is None else Path(self._job.start_from).name,
            "result": dict(self._history[-1]) if self._history else {},
        }
        self._training.write(self._job.out / WEIGHTS, self._sample, about)


class Training:
    """A network in training on ``pictures``; ``step`` counts what is done of it.

    ``worlds`` are the simulated ones that it saw, now or before it was resumed or begun from other weights.
    """

    def __init__(self, options: TrainingOptions, pictures: Sequence[Picture]) -> None:
        self.options = options
        self._pictures = pictures
        self._device = _device(options.device)
        if options.threads:
            torch.set_num_threads(options.threads)
        torch.manual_seed(options.seed)
        network = KeypointNet(options.architecture, options.dropout)
        self.network = in_channels_last(network.to(self._device))
        self.judge = InlierOutlierNet().to(self._device)
        self._frozen = _detecting(self.network) if options.only == "descriptors" else []
        for part in self._frozen:
            part.requires_grad_(False)
        trained = [p for p in (*self.network.parameters(), *self.judge.parameters()) if p.requires_grad]
        self._optimiser = Adam(trained, lr=options.learning_rate)
        self.step = 0
        self.target: str = options.target
        """That of the detector: where only descriptors are trained, it is that of the weights begun with."""
        self.worlds: list[dict[str, Any]] = []

    @property
    def epoch_steps(self) -> int:
        """Steps an epoch."""
        return max(1, (self.options.epoch_samples or len(self._pictures)) // self.options.batch)

    @property
    def total_steps(self) -> int:
        return self.epoch_steps * self.options.epochs

    def start_from(self, other: weights.Weights) -> None:
        """Fine-tune: begin with the weights of a network of the same architecture."""
        if other.architecture.shapes != self.options.architecture.shapes:
            raise ConfigError(
                f"the weights to start from are of the network {other.architecture.name}, not of "
                f"{self.options.architecture.name}; choose it with -o network= and -o width="
            )
        fill(self.network, other)
        if self.options.only == "descriptors":
            self.target = other.target
        self.saw(other.card.get("simulated_worlds", ()))

    def saw(self, worlds: Iterable[dict[str, Any]]) -> None:
        """Keep in mind that ``worlds`` are among what it is trained on."""
        self.worlds += [world for world in worlds if world not in self.worlds]

    def steps(self) -> Iterator[Mapping[str, float]]:
        """Train to the end; yields each step's losses by name."""
        self.network.train()
        self.judge.train()
        for part in self._frozen:
            part.eval()
        for made_ready in self._made_ready():
            epoch = self.step // self.epoch_steps
            rate = self.options.learning_rate * 0.5 ** sum(epoch >= e for e in self.options.halve_at)
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            # Dropout, too, depends on the number of the step alone.
            torch.manual_seed(int(np.random.default_rng([self.options.seed, 3, self.step]).integers(2**62)))
            values = self._losses(made_ready, taught=self._taught(self.step))
            self._optimiser.zero_grad(set_to_none=True)
            values["total"].backward()  # type: ignore[no-untyped-call]
            self._optimiser.step()
            self.step += 1
            yield {name: float(value.detach()) for name, value in values.items()}

    def _taught(self, step: int) -> bool:
        """Whether it belongs to the lessons."""
        return step // self.epoch_steps < self.options.lesson_epochs

    def _made_ready(self) -> Iterator[Any]:
        """What each step to come is trained on; a step's depends on nothing but its number."""
        to_come = ((step, self._taught(step)) for step in range(self.step, self.total_steps))
        return iter(
            DataLoader(
                _Samples(self._pictures, self.options),
                batch_size=None,
                sampler=to_come,
                num_workers=self.options.workers,
                # Forked, they would wait for threads of OpenCV's that are not there.
                multiprocessing_context="spawn" if self.options.workers else None,
                worker_init_fn=_on_one_thread,
                pin_memory=self._device.type == "cuda",
            )
        )

    def _losses(self, made_ready: Any, *, taught: bool) -> Mapping[str, Tensor]:
        """Those of a step, ``total`` to be minimised."""
        on_device = (tensor.to(self._device, non_blocking=True) for tensor in made_ready)
        if self.options.target != "repeatability":
            return followed_losses(self.network, Told(*on_device), self.options.precision)
        return step_losses(self.network, self.judge, self.options, Pair(*on_device), taught=taught)

    def validate(self, held_out: Sequence[Picture]) -> dict[str, float]:
        """How good the network is by now on pictures not trained on."""
        made, target = self.weights(), self.options.target
        if target == "repeatability":
            runtime: Runtime = "cuda" if self._device.type == "cuda" else "torch"
            return validate(made, held_out, self.options.seed, runtime)
        return {"rank_correlation": rank_correlation(of_weights(made), cast(Sequence[Followed], held_out), target)}

    def save(self, path: Path, history: Sequence[Mapping[str, float]]) -> None:
        """Write all that the training depends on, whole or not at all; ``history`` goes along."""
        part = path.with_name(f"{path.name}.part")
        torch.save(
            {
                "options": asdict(self.options),
                "step": self.step,
                "network": self.network.state_dict(),
                "judge": self.judge.state_dict(),
                "optimiser": self._optimiser.state_dict(),
                "history": [dict(row) for row in history],
                "simulated_worlds": self.worlds,
                "target": self.target,
            },
            part,
        )
        os.replace(part, path)

    def resume(self, path: Path) -> list[Mapping[str, float]]:
        """Go on from what :meth:`save` wrote, and return the history that went along.

        Raises :class:`ConfigError` where it is damaged, or of a training that other options determined.
        """
        try:
            kept = torch.load(path, map_location=self._device, weights_only=True)
            before = {name: value for name, value in kept["options"].items() if name not in _FREE}
        except Exception as error:  # torch raises many kinds
            raise ConfigError(f"{path} is damaged or no checkpoint of a training; train anew") from error
        now = {name: value for name, value in asdict(self.options).items() if name not in _FREE}
        if before != now:
            changed = ", ".join(sorted(name for name in now if before.get(name) != now[name]))
            raise ConfigError(f"{path} is of a training with other options ({changed}); resume with the same")
        self.network.load_state_dict(kept["network"])
        self.judge.load_state_dict(kept["judge"])
        self._optimiser.load_state_dict(kept["optimiser"])
        self.step = kept["step"]
        self.saw(kept.get("simulated_worlds", ()))
        self.target = kept.get("target", "repeatability")
        return list(kept["history"])

    def weights(self) -> weights.Weights:
        """The network's weights as they are now."""
        state = self.network.state_dict()
        tensors = {n: x.cpu().numpy().copy() for n, x in state.items() if not n.endswith("num_batches_tracked")}
        describes = self.options.target == "repeatability" and self.options.only != "detector"
        return weights.Weights(self.options.architecture, tensors, {"target": self.target, "descriptors": describes})

    def write(self, path: Path, sample: Sequence[Picture], about: Mapping[str, Any]) -> None:
        """Write the weights as they are now, with ranges for int8 measured on a ``sample`` of pictures.

        Their card has the training, and what else is known ``about`` it.
        """
        made = self.weights()
        ranges = measure_ranges(made, (picture.pixels for picture in sample))
        card = {**about, "simulated_worlds": self.worlds, "options": asdict(self.options), **made.card}
        weights.save(path, replace(made, card=card, activation_ranges=ranges))


@dataclass(frozen=True, slots=True)
class _Samples(Dataset[Any]):
    """What each step of a training is trained on."""

    pictures: Sequence[Picture]
    options: TrainingOptions

    def __getitem__(self, key: tuple[int, bool]) -> Any:
        """Of the step with a number, and whether it belongs to the lessons."""
        step, taught = key
        if self.options.target != "repeatability":
            return told(cast(Sequence[Followed], self.pictures), self.options, step)
        corners_taught = taught and self.options.only != "descriptors"
        return batch(self.pictures, self.options, step, corners_taught=corners_taught)


def _on_one_thread(_: int) -> None:
    """Of several processes that each use all cores all are slow."""
    import cv2

    cv2.setNumThreads(1)


def step_losses(
    network: KeypointNet,
    judge: InlierOutlierNet,
    options: TrainingOptions,
    pairs: Pair[Tensor],
    *,
    taught: bool = False,
) -> dict[str, Tensor]:
    """The losses of a batch of pairs, of the lessons where it is ``taught``; ``total`` is what is minimised."""
    detecting, describing = options.only != "descriptors", options.only != "detector"
    with torch.autocast(pairs.source.device.type, torch.bfloat16, enabled=options.precision == "bfloat16"):
        views = (x.contiguous(memory_format=torch.channels_last) for x in (pairs.source, pairs.target))
        a, b = (network(view, descriptors=describing) for view in views)
    if taught:
        values = {"matching": matching_loss(a, b, pairs.homography)} if describing else {}
        if detecting:
            values |= teach(a, b, pairs.source_lesson, pairs.target_lesson)
        return values | {"total": sum(values.values(), torch.zeros(()))}
    values = dict(losses(a, b, pairs.homography, judge if describing else None))
    if not detecting:
        return {"descriptor": values["descriptor"], "total": values["descriptor"]}
    weighted = (_LOSS_WEIGHTS.get(name, 1.0) * value for name, value in values.items())
    values["total"] = sum(weighted, torch.zeros(()))
    return values


def validate(
    made: weights.Weights, pictures: Sequence[Picture], seed: int, runtime: Runtime = "torch"
) -> dict[str, float]:
    """How well points are found again in images not trained on, under one synthetic homography each, at 320 x 240.

    ``repeatability`` is the share of the 300 strongest points of one view that have one of the other's within 3 px,
    either way, ``localisation_px`` the mean distance of those.
    """
    import cv2

    detector = Detector(made, KeypointNetOptions(runtime=runtime, precision="float32", nms_px=4.0, min_contrast=0))
    scores = []
    for k, picture in enumerate(pictures):
        image = cv2.resize(picture.pixels, _VALIDATION_SIZE, interpolation=cv2.INTER_AREA)
        H_21 = random_homography(np.random.default_rng([seed, 2, k]), _VALIDATION_SIZE)
        moved = cv2.warpPerspective(image, H_21, _VALIDATION_SIZE, flags=cv2.INTER_LINEAR)
        # Some of the points of one view the other does not show.
        first, second = (
            detector.detect(view.astype(np.uint8, copy=False), 4 * _VALIDATION_TOP) for view in (image, moved)
        )
        scores.append(score_pair(first, second, H_21, _VALIDATION_SIZE, _VALIDATION_TOP))
    # Where nothing was found again there is no distance.
    distances = np.array([score.localisation_px for score in scores], np.float64)
    repeatability = float(np.mean([score.repeatability for score in scores]))
    return {"repeatability": repeatability, "localisation_px": float(np.nanmean(distances))}


def _detecting(network: KeypointNet) -> list[Module]:
    """The layers that keypoints depend on; the rest only serves descriptors and, of a network of peaks, training."""
    heads = ("R",) if network.architecture.peaks else ("Da", "Db", "Pa", "Pb")
    return [network.get_submodule(f"conv{name}") for name in (*network.architecture.detecting, *heads)]


def _device(wanted: str) -> torch.device:
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is cuda, but torch sees no CUDA device; choose auto or cpu")
    return torch.device("cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu")
