"""How an estimator begins: at rest, or in motion by visual-inertial alignment. Shared by all back-ends."""

from vioframe.estimation.initialization.estimate import InitialEstimate
from vioframe.estimation.initialization.hand_eye import CameraRotation, RotationCalibrator
from vioframe.estimation.initialization.initializer import Initializer
from vioframe.estimation.initialization.options import InitializationOptions

__all__ = ["CameraRotation", "InitialEstimate", "InitializationOptions", "Initializer", "RotationCalibrator"]
