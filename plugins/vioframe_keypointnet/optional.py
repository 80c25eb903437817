"""What comes as an extra: one clear error where it is absent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from vioframe.errors import ConfigError


@contextmanager
def needs(library: str, extra: str) -> Iterator[None]:
    """Around imports of ``library``: raises :class:`ConfigError` with the command that installs it."""
    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"this use of KeypointNet needs {library}, which is not installed or does not load ({error}): "
            f"pip install 'vioframe[{extra}]'"
        ) from error
