"""Trajectories: files, association, alignment and error metrics. Everything is pure; nothing mutates its input."""

from vioframe.trajectory.alignment import ALIGNMENTS, Alignment
from vioframe.trajectory.association import associate
from vioframe.trajectory.comparison import Comparison
from vioframe.trajectory.evaluation import TrajectoryErrors, evaluate
from vioframe.trajectory.formats import load_trajectory, tum_line, write_tum
from vioframe.trajectory.metrics import RelativeErrors, Stats
from vioframe.trajectory.nees import Nees
from vioframe.trajectory.trajectory import Trajectory

__all__ = [
    "ALIGNMENTS",
    "Alignment",
    "Comparison",
    "Nees",
    "RelativeErrors",
    "Stats",
    "Trajectory",
    "TrajectoryErrors",
    "associate",
    "evaluate",
    "load_trajectory",
    "tum_line",
    "write_tum",
]
