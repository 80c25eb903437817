"""The eleven sequences of EuRoC (Burri et al., IJRR 2016): where to start, and a simulated flight in place of each.

A start skips the shaking and resting before the take-off, as OpenVINS' evaluations do. A stand-in has the length of
the sequence, its path and turning within a few per cent, and the light of its hall; it is not that flight, and what
is measured on it says nothing about EuRoC's images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vioframe.parts.config import PartConfig


@dataclass(frozen=True, slots=True)
class StandIn:
    """A simulated flight: of the installed flight ``flight`` for ``duration_s``, under ``conditions``."""

    flight: PartConfig
    duration_s: float
    conditions: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of a sequence without having it. ``start_s`` is for the sequence, not for the stand-in."""

    start_s: float
    stand_in: StandIn


def _tour(
    route: int, duration_s: float, mean_speed_m_s: float, width_m: float, height_m: float, **conditions: float
) -> StandIn:
    options: dict[str, Any] = {
        "route": route,
        "mean_speed_m_s": mean_speed_m_s,
        "width_m": width_m,
        "height_m": height_m,
    }
    return StandIn(PartConfig(name="tour", options=options), duration_s, conditions)


EUROC: Mapping[str, Known] = {
    "MH_01_easy": Known(40.0, _tour(1, 142.0, 0.6, 10.0, 3.0)),
    "MH_02_easy": Known(35.0, _tour(2, 115.0, 0.64, 10.0, 3.0)),
    "MH_03_medium": Known(5.0, _tour(3, 127.0, 1.03, 12.0, 3.0)),
    "MH_04_difficult": Known(10.0, _tour(4, 89.0, 1.03, 15.0, 3.0, low_light=0.3)),
    "MH_05_difficult": Known(5.0, _tour(5, 106.0, 0.92, 15.0, 3.0, low_light=0.3)),
    "V1_01_easy": Known(0.0, _tour(6, 144.0, 0.41, 5.0, 1.5)),
    "V1_02_medium": Known(0.0, _tour(7, 84.0, 0.91, 5.0, 1.5)),
    "V1_03_difficult": Known(0.0, _tour(8, 105.0, 0.75, 4.0, 1.5, motion_blur=0.3)),
    "V2_01_easy": Known(0.0, _tour(9, 112.0, 0.33, 4.0, 1.5)),
    "V2_02_medium": Known(0.0, _tour(10, 115.0, 0.72, 5.0, 1.5)),
    "V2_03_difficult": Known(0.0, _tour(11, 115.0, 0.75, 5.0, 1.5, motion_blur=0.3)),
}
