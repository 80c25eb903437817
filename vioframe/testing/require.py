"""What the checks share: the one way in which the kit complains, and what it compares results and inputs by."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any, NoReturn

import numpy as np


def fail(message: str) -> NoReturn:
    raise AssertionError(message)


def require(condition: object, message: str) -> None:
    """Unlike the ``assert`` statement this also holds under ``python -O``."""
    if not condition:
        fail(message)


def same(a: Any, b: Any) -> bool:
    """Whether two results, dataclasses of arrays or None, are equal to the last bit."""
    if a is None or b is None:
        return a is b
    try:
        np.testing.assert_equal(asdict(a), asdict(b))
    except AssertionError:
        return False
    return True


def freeze(*parts: Any) -> None:
    """Make the arrays of dataclasses read-only, so that a plug-in that changes its input fails where it does."""
    for part in parts:
        for field in fields(part):
            if isinstance(array := getattr(part, field.name), np.ndarray):
                array.flags.writeable = False
