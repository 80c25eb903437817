"""The conformance kit: what every plug-in must keep to, as functions to call from a plug-in's own tests.

    from vioframe.testing import check_detector
    def test_conforms():
        check_detector(MyDetector)

Each raises :class:`AssertionError` saying what is not as promised in :mod:`vioframe.interfaces`.
"""

from vioframe.testing.backend import check_backend
from vioframe.testing.dataset import check_dataset
from vioframe.testing.detector import check_detector
from vioframe.testing.flight import check_flight
from vioframe.testing.loop_closer import check_loop_closer
from vioframe.testing.metric import check_metric
from vioframe.testing.source import check_source

__all__ = [
    "check_backend",
    "check_dataset",
    "check_detector",
    "check_flight",
    "check_loop_closer",
    "check_metric",
    "check_source",
]
