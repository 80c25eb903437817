"""How an estimator begins: at rest, or in motion by visual-inertial alignment. Shared by all back-ends."""

from vioframe.estimation.initialization.dynamic import warm_up
from vioframe.estimation.initialization.initializer import GIVEN, Initializer
from vioframe.estimation.initialization.window import InitialEstimate

__all__ = ["GIVEN", "InitialEstimate", "Initializer", "warm_up"]
