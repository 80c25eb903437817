"""How an estimator begins: at rest, or in motion by visual-inertial alignment. Shared by all back-ends."""

from vioframe.estimation.initialization.dynamic import warm_up
from vioframe.estimation.initialization.hand_eye import CameraRotation, RotationCalibrator
from vioframe.estimation.initialization.initializer import Initializer
from vioframe.estimation.initialization.window import InitialEstimate

__all__ = ["CameraRotation", "InitialEstimate", "Initializer", "RotationCalibrator", "warm_up"]
