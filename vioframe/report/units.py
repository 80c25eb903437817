"""How lengths are told: in millimetres below 0.1 m, in metres from there on. Files keep metres."""

from __future__ import annotations

from math import isnan

_METRES_FROM = 0.1


def length_unit(metres: float) -> tuple[float, str]:
    """The unit that a length is told in, and the factor from metres to it."""
    return (1.0, "m") if abs(metres) >= _METRES_FROM else (1e3, "mm")


def length(metres: float, std: float | None = None) -> str:
    """To 0.1 mm, 1 mm below ten metres, 0.1 m above; with a standard deviation where there is one, not NaN."""
    scale, unit = length_unit(metres)
    digits = 1 if unit == "mm" or abs(metres) >= 10.0 else 3
    around = "" if std is None or isnan(std) else f" ± {scale * std:.{digits}f}"
    return f"{scale * metres:.{digits}f}{around} {unit}"
