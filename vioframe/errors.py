"""The errors vioframe raises on purpose. Each message is one line that says what is wrong and what to do about it."""

from collections.abc import Iterator
from contextlib import contextmanager
from reprlib import Repr


class VioframeError(Exception):
    """Root of all errors raised by vioframe; the command line turns it into one line and exit code 2."""


class ConfigError(VioframeError):
    """A configuration file or option is invalid."""


class PluginError(VioframeError):
    """A plug-in is unknown, registered twice, or broke its contract."""


class DatasetError(VioframeError):
    """A data set cannot be read as asked."""


class SourceError(DatasetError):
    """A live source is not there, or not any more."""


class ImageSizeError(DatasetError):
    """Images of ``size`` (width, height) px are not of the size that their camera is ``calibrated`` for."""

    def __init__(self, message: str, size: tuple[int, int], calibrated: tuple[int, int]) -> None:
        super().__init__(message)
        self.size, self.calibrated = size, calibrated


class CalibrationError(VioframeError):
    """A calibration file is missing, unreadable or inconsistent."""


class TrajectoryError(VioframeError):
    """A trajectory file is malformed, or two trajectories cannot be compared."""


class DivergedError(VioframeError):
    """An estimate can no longer be believed; the message says why. The life cycle takes it and begins anew."""


class RunError(VioframeError):
    """A run folder exists already, is incomplete, or cannot be written."""


_MOST_SHOWN = 200
_repr = Repr()
_repr.maxstring = _repr.maxother = 100
_repr.maxlist = _repr.maxdict = 10


def shown(value: object) -> str:
    """``value`` as it is shown in a message, which is a line however long or deep the value."""
    return shortened(_repr.repr(value))


def shortened(text: object) -> str:
    """Some text in one line, cut off where that grows long."""
    line = " ".join(str(text).split())
    return line if len(line) <= _MOST_SHOWN else f"{line[:_MOST_SHOWN]}..."


@contextmanager
def needs(library: str, extra: str, *, user: str) -> Iterator[None]:
    """Around the import of a ``library`` that is optional: without it :class:`PluginError` says which extra has it.

    ``user`` is what the message begins with, such as ``"detector 'surf'"``.
    """
    try:
        yield
    except ImportError as error:
        raise PluginError(
            f"{user} needs {library}, which is not installed or does not load ({error}): "
            f"pip install 'vioframe[{extra}]'"
        ) from error
