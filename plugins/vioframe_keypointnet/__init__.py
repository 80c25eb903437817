"""Detector ``keypointnet``, the keypoint network KP2D by whichever library runs it fastest here, and its trainer."""

from __future__ import annotations

from collections.abc import Mapping

from vioframe.errors import needs
from vioframe.interfaces import Detector, DetectorFactory, Trainer, TrainerFactory
from vioframe.parts.hooks import hookimpl
from vioframe.parts.options import plugin_factory
from vioframe.types import TrainingJob
from vioframe_keypointnet.options import KeypointNetOptions, TrainingOptions


def keypointnet(options: KeypointNetOptions) -> Detector:
    """Learned keypoints, sub-pixel, one candidate a cell of 8 px (KP2D; Tang et al., ICLR 2020)."""
    from vioframe_keypointnet.detector import KeypointNet
    from vioframe_keypointnet.weights import load

    return KeypointNet(load(options.weights), options)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"keypointnet": plugin_factory(keypointnet, KeypointNetOptions)}


def trainer(job: TrainingJob, options: TrainingOptions) -> Trainer:
    """Trains a KeypointNet on pairs of views of images, which need no labels."""
    with needs("torch", "keypointnet", user="trainer 'keypointnet'"):
        from vioframe_keypointnet.training.trainer import KeypointNetTrainer

    return KeypointNetTrainer(job, options)


@hookimpl
def vioframe_trainers() -> Mapping[str, TrainerFactory]:
    return {"keypointnet": plugin_factory(trainer, TrainingOptions)}
