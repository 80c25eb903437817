"""The main loop: one camera frame at a time, from measurements to an estimate.

    bag -> measurements -> packets -> tracks -> estimate -> files -> report

Nothing flows back from the back-end to the front-end. A live view, a progress bar and the recorder are consumers of the
:class:`~vioframe.types.Step` objects that :func:`run` yields.
"""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

from vioframe.errors import PluginError
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.incidents import Incidents
from vioframe.interfaces import Backend, Dataset, Detector
from vioframe.io.synchronise import synchronise
from vioframe.types import Estimate, Step


def run(
    dataset: Dataset,
    detector: Detector,
    backend: Backend,
    options: FrontendOptions | None = None,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    incidents: Incidents | None = None,
) -> Iterator[Step]:
    """Estimate motion along ``dataset``, yielding one :class:`Step` a frame.

    ``start_s`` seconds are skipped, counted from the first frame's stamp; ``duration_s`` is how much is then played.
    ``incidents`` collects what was handled on the way (dropped samples, unusable images, failing detectors).
    """
    incidents = Incidents() if incidents is None else incidents
    frontend = Frontend(detector, dataset.calibration.camera, options or FrontendOptions(), incidents)
    packets = synchronise(
        dataset.measurements(),
        time_offset_ns=dataset.calibration.time_offset_ns,
        start_s=start_s,
        duration_s=duration_s,
        incidents=incidents,
    )
    for imu, frame in packets:
        tracks = frontend.track(imu, frame, dataset.calibration.R_BC)
        begin = perf_counter()
        estimate = backend.process(imu, tracks)
        backend_s = perf_counter() - begin
        if not isinstance(estimate, Estimate):
            raise PluginError(f"the back-end returned a {type(estimate).__name__}, not an Estimate; repair the plug-in")
        within = {f"backend.{stage}": seconds for stage, seconds in estimate.stage_seconds.items()}
        yield Step(frame, tracks, estimate, {**frontend.stage_seconds, "backend": backend_s, **within})
