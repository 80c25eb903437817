"""How an estimator begins: at rest, or in motion by visual-inertial alignment. Shared by all back-ends."""

from vioframe.initialization.estimate import InitialEstimate
from vioframe.initialization.hand_eye import CameraRotation, RotationCalibrator
from vioframe.initialization.initializer import Initializer
from vioframe.initialization.options import InitializationOptions
from vioframe.initialization.starter import Starter

__all__ = ["CameraRotation", "InitialEstimate", "InitializationOptions", "Initializer", "RotationCalibrator", "Starter"]
