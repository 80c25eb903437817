"""``realsense:`` or ``realsense:SERIAL``: infrared cameras and IMU of a RealSense D400 (D435i, D455 and others).

device -> streams -> one clock -> readings in pairs, images in sets         :mod:`source` has them go together
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field

from vioframe.interfaces import Source, SourceFactory
from vioframe.parts.hooks import hookimpl


def realsense(
    address: str,
    *,
    cameras: Annotated[list[str] | str | None, "cam0 (left) or cam1 (right); by default both"] = None,
    resolution: Annotated[str, Field(pattern=r"^\d+x\d+$", description="of the images, px")] = "848x480",
    frame_rate_hz: Annotated[int, Field(gt=0, description="images a second")] = 30,
    emitter: Annotated[bool, "project the pattern for depth, dots that move with the camera and mislead it"] = False,
    calibration: Annotated[
        list[Path] | Path | None, "calibration files or folder; by default the device's own is read"
    ] = None,
) -> Source:
    """A RealSense camera with an IMU: its infrared images and readings, through pyrealsense2.

    ``address`` is its serial number; the first one that is found where it is empty.
    """
    from vioframe_realsense.device import Wanted, plugged_in
    from vioframe_realsense.source import RealSense

    width, height = map(int, resolution.split("x"))
    wanted = Wanted((width, height), frame_rate_hz, emitter)
    return RealSense(plugged_in, address, wanted, cameras=cameras, calibration=calibration)


@hookimpl
def vioframe_sources() -> Mapping[str, SourceFactory]:
    return {"realsense": realsense}
