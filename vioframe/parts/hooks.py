"""The hooks through which every part comes in, the built-in ones included.

A plug-in is a module that implements any of these with :data:`hookimpl` and is named in the ``vioframe`` entry-point
group of its distribution. Factories should import heavy libraries inside, so that listing plug-ins stays quick.
"""

from collections.abc import Mapping

import pluggy

from vioframe.interfaces import (
    BackendFactory,
    DatasetFactory,
    DetectorFactory,
    FlightFactory,
    LoopCloserFactory,
    MetricFactory,
    SourceFactory,
    TrainerFactory,
    WorldFactory,
)

PROJECT = "vioframe"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def vioframe_detectors() -> Mapping[str, DetectorFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(**options) -> Detector``."""


@hookspec
def vioframe_backends() -> Mapping[str, BackendFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(**options) -> Backend``."""


@hookspec
def vioframe_loop_closers() -> Mapping[str, LoopCloserFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(calibration, **options) -> LoopCloser``."""


@hookspec
def vioframe_datasets() -> Mapping[str, DatasetFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(path, **options) -> Dataset``."""


@hookspec
def vioframe_sources() -> Mapping[str, SourceFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(address, **options) -> Source``, for data called ``NAME:ADDRESS``."""


@hookspec
def vioframe_flights() -> Mapping[str, FlightFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(duration_s, R_LB, **options) -> Flight``.

    ``R_LB`` (3, 3) is the body's attitude in the levelled frame L (x ahead, y left, z up) whose x axis the camera looks
    along.
    """


@hookspec
def vioframe_worlds() -> Mapping[str, WorldFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(p_WB, rng, **options) -> World``.

    ``p_WB`` (N, 3) m is the path that the world must leave free, ``rng`` a numpy Generator.
    """


@hookspec
def vioframe_metrics() -> Mapping[str, MetricFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(**options) -> Metric``, for ``vioframe evaluate --metric NAME``."""


@hookspec
def vioframe_trainers() -> Mapping[str, TrainerFactory]:  # type: ignore[empty-body]
    """Map names to factories: ``factory(job, **options) -> Trainer``, behind ``vioframe train NAME``.

    ``job`` is a :class:`vioframe.types.TrainingJob`.
    """
