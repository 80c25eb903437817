"""The training loop: steps that depend on nothing but their number, and a checkpoint from which they go on."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import Module
from torch.optim import Adam

from vioframe.errors import ConfigError
from vioframe_keypointnet.network import InlierOutlierNet, KeypointNet
from vioframe_keypointnet.training.images import Picture
from vioframe_keypointnet.training.lessons import matching_loss, teach
from vioframe_keypointnet.training.losses import losses
from vioframe_keypointnet.training.options import TrainingOptions
from vioframe_keypointnet.training.samples import Batch, batch

# What may be chosen anew when a training goes on.
_FREE = frozenset({"epochs", "device", "validation_images", "threads"})


class Training:
    """A network in training on ``pictures``; ``step`` counts what is done of it."""

    def __init__(self, options: TrainingOptions, pictures: Sequence[Picture]) -> None:
        self.options = options
        self._pictures = pictures
        self._device = _device(options.device)
        if options.threads:
            torch.set_num_threads(options.threads)
        torch.manual_seed(options.seed)
        network = KeypointNet(options.architecture, options.dropout)
        self.network = network.to(self._device, memory_format=torch.channels_last)
        self.judge = InlierOutlierNet().to(self._device)
        self._frozen = _detecting(self.network) if options.descriptors_only else []
        for part in self._frozen:
            part.requires_grad_(False)
        trained = [p for p in (*self.network.parameters(), *self.judge.parameters()) if p.requires_grad]
        self._optimiser = Adam(trained, lr=options.learning_rate)
        self.step = 0

    @property
    def epoch_steps(self) -> int:
        """Steps an epoch."""
        return max(1, (self.options.epoch_samples or len(self._pictures)) // self.options.batch)

    @property
    def total_steps(self) -> int:
        return self.epoch_steps * self.options.epochs

    def start_from(self, tensors: Mapping[str, NDArray[Any]]) -> None:
        """Fine-tune: begin with the weights of a network of the same architecture."""
        state = {name: torch.from_numpy(np.array(values)) for name, values in tensors.items()}
        try:
            missing, unexpected = self.network.load_state_dict(state, strict=False)
        except RuntimeError as error:
            raise ConfigError(_OTHER_NETWORK.format(self.options.network)) from error
        if unexpected or any(not name.endswith("num_batches_tracked") for name in missing):
            raise ConfigError(_OTHER_NETWORK.format(self.options.network))

    def steps(self) -> Iterator[Mapping[str, float]]:
        """Train to the end; yields each step's losses by name."""
        self.network.train()
        self.judge.train()
        for part in self._frozen:
            part.eval()
        while self.step < self.total_steps:
            epoch = self.step // self.epoch_steps
            rate = self.options.learning_rate * 0.5 ** sum(epoch >= e for e in self.options.halve_at)
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            taught = epoch < self.options.lesson_epochs
            corners_taught = taught and not self.options.descriptors_only
            pairs = batch(self._pictures, self.options, self.step, corners_taught=corners_taught).to(self._device)
            # Dropout, too, depends on the number of the step alone.
            torch.manual_seed(int(np.random.default_rng([self.options.seed, 3, self.step]).integers(2**62)))
            values = step_losses(self.network, self.judge, self.options, pairs, taught=taught)
            self._optimiser.zero_grad(set_to_none=True)
            values["total"].backward()  # type: ignore[no-untyped-call]
            self._optimiser.step()
            self.step += 1
            yield {name: float(value.detach()) for name, value in values.items()}

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
        return list(kept["history"])

    def tensors(self) -> dict[str, NDArray[Any]]:
        """The network's weights as they are now, for a weights file."""
        state = self.network.state_dict()
        return {name: x.cpu().numpy().copy() for name, x in state.items() if not name.endswith("num_batches_tracked")}


def step_losses(
    network: KeypointNet,
    judge: InlierOutlierNet,
    options: TrainingOptions,
    pairs: Batch,
    *,
    taught: bool = False,
) -> dict[str, Tensor]:
    """The losses of a batch of pairs, of the lessons where it is ``taught``; ``total`` is what is minimised."""
    with torch.autocast(pairs.source.device.type, torch.bfloat16, enabled=options.precision == "bfloat16"):
        seen = [network(x.contiguous(memory_format=torch.channels_last)) for x in (pairs.source, pairs.target)]
    a, b = (replace(d, descriptors=d.descriptors.float()) for d in seen)
    if taught:
        values = {"matching": matching_loss(a, b, pairs.homography)}
        if not options.descriptors_only:
            values |= teach(a, b, pairs.source_lesson, pairs.target_lesson)
        return values | {"total": sum(values.values(), torch.zeros(()))}
    values = dict(losses(a, b, pairs.homography, judge, options.top))
    if options.descriptors_only:
        return {"descriptor": values["descriptor"], "total": values["descriptor"]}
    values["total"] = (
        options.location_weight * values["location"]
        + options.descriptor_weight * values["descriptor"]
        + options.score_weight * values["score"]
        + values["inlier"]
    )
    return values


def _detecting(network: KeypointNet) -> list[Module]:
    """The layers that keypoints depend on; the rest only serves descriptors and, of a network of peaks, training."""
    if network.architecture.peaks:
        names = [*(f"conv{name}" for name, *_ in network.architecture.encoder if name < "3"), "convR"]
    else:
        names = [*(f"conv{name}" for name, *_ in network.architecture.encoder), "convDa", "convDb", "convPa", "convPb"]
    return [network.get_submodule(name) for name in names]


_OTHER_NETWORK = "the weights to start from are of another network than {!r}; choose it with -o network="


def _device(wanted: str) -> torch.device:
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is cuda, but torch sees no CUDA device; choose auto or cpu")
    return torch.device("cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu")
