"""The one way in which the kit complains."""

from typing import NoReturn


def fail(message: str) -> NoReturn:
    raise AssertionError(message)


def require(condition: object, message: str) -> None:
    """Unlike the ``assert`` statement this also holds under ``python -O``."""
    if not condition:
        fail(message)
