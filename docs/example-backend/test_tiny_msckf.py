"""All the tests that a back-end plug-in needs to begin with."""

from vioframe_tiny_msckf import TinyMsckf

from vioframe.testing import check_backend


def test_conforms():
    check_backend(TinyMsckf)
