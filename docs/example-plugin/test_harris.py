"""All the tests that a detector plug-in needs to begin with."""

from vioframe_harris import Harris

from vioframe.testing import check_detector


def test_conforms():
    check_detector(Harris)
