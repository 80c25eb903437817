"""Plug-in visual-inertial odometry: EuRoC bag in, evaluated trajectory out; or push your own camera's measurements.

Read :mod:`vioframe.odometry` first, then :mod:`vioframe.types`, the glossary. Importing this package is cheap: OpenCV,
numba, torch and Open3D are loaded only by the parts that use them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from vioframe.interfaces import Dataset
    from vioframe.odometry import Odometry as Odometry
    from vioframe.parts.hooks import hookimpl as hookimpl

__version__ = "0.1.0"

_WHERE = {"Odometry": "vioframe.odometry", "hookimpl": "vioframe.parts.hooks"}


def __getattr__(name: str) -> Any:
    """What most users ask for, loaded when they do."""
    if name in _WHERE:
        return getattr(import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'vioframe' has no attribute {name!r}")


def open_dataset(path: str | Path, **options: Any) -> Dataset:
    """Open a recording with the installed reader that accepts it; ``options`` are the reader's."""
    from vioframe.parts import registry

    return registry.load().open_dataset(path, options=options)
