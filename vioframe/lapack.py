"""BLAS and LAPACK, as far as numpy has no name for it: scipy's functions, imported when the first of them is used.

To import them takes a tenth of all that the first frame of a run would wait for, and it needs none of them.
"""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """Only what this module has not got yet comes here."""
    if name.startswith("__"):
        raise AttributeError(name)
    from scipy.linalg import blas, lapack

    globals()[name] = getattr(lapack if hasattr(lapack, name) else blas, name)
    return globals()[name]
