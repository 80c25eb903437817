"""Trajectories: files, association, alignment and error metrics. Everything is pure; nothing mutates its input."""

from vioframe.evaluation.alignment import ALIGNED_BY, ALIGNMENTS, Alignment
from vioframe.evaluation.evaluation import Comparison, TrajectoryErrors, associate, evaluate
from vioframe.evaluation.metrics import RelativeErrors, Stats
from vioframe.evaluation.nees import Nees

__all__ = [
    "ALIGNED_BY",
    "ALIGNMENTS",
    "Alignment",
    "Comparison",
    "Nees",
    "RelativeErrors",
    "Stats",
    "TrajectoryErrors",
    "associate",
    "evaluate",
]
