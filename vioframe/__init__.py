"""Plug-in visual-inertial odometry: EuRoC bag in, evaluated trajectory out.

Read :mod:`vioframe.pipeline` first, then :mod:`vioframe.types`, the glossary. Importing this package is cheap: OpenCV,
numba, torch and Open3D are loaded only by the parts that use them.
"""

__version__ = "0.1.0"
