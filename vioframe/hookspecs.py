"""The hooks through which every detector, back-end and reader comes in, the built-in ones included.

A plug-in is a module that implements any of these with :data:`hookimpl` and is named in the ``vioframe`` entry-point
group of its distribution. Factories should import heavy libraries inside, so that listing plug-ins stays quick.
"""

from collections.abc import Mapping

import pluggy

from vioframe.interfaces import BackendFactory, DatasetFactory, DetectorFactory

PROJECT = "vioframe"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def vioframe_detectors() -> Mapping[str, DetectorFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(**options) -> Detector``."""


@hookspec
def vioframe_backends() -> Mapping[str, BackendFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(calibration, **options) -> Backend``."""


@hookspec
def vioframe_datasets() -> Mapping[str, DatasetFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(path, **options) -> Dataset``."""
