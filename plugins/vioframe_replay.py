"""``replay:RECORDING``: any recording at its own pace, as if its sensors were plugged in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from vioframe.errors import DatasetError
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.ahead import read_ahead
from vioframe.live.pace import paced
from vioframe.parts import registry
from vioframe.parts.hooks import hookimpl
from vioframe.types import Calibration, Measurement, NavState

if TYPE_CHECKING:
    from vioframe.interfaces import SourceFactory


class Replay:
    """A recording at its own pace: each measurement comes when it is due by its stamp, the first at once."""

    def __init__(
        self,
        address: str,
        *,
        speed: Annotated[float, Field(gt=0.0, le=100.0, description="how many times as fast as it happened")] = 1.0,
        cameras: Annotated[list[str] | str | None, "cameras to use; by default all calibrated ones"] = None,
        calibration: Annotated[list[Path] | Path | None, "calibration files or folder"] = None,
    ) -> None:
        if not address:
            raise DatasetError("no recording named: replay:FLIGHT.bag")
        given = {"cameras": cameras, "calibration": calibration}
        self._recording = registry.load().open_dataset(
            address, options={k: v for k, v in given.items() if v is not None}
        )
        self._speed = speed
        self._closed = Event()

    @property
    def name(self) -> str:
        return self._recording.name

    @property
    def calibration(self) -> Calibration:
        return self._recording.calibration

    @property
    def frame_count(self) -> int | None:
        return self._recording.frame_count

    @property
    def ground_truth(self) -> Trajectory | None:
        return self._recording.ground_truth

    def measurements(self) -> Iterator[Measurement]:
        """In the order of the recording, decoded ahead of time."""
        return paced(read_ahead(self._recording.measurements()), self._closed, speed=self._speed)

    def tell(self, state: NavState) -> None:
        """Nobody listens."""

    def close(self) -> None:
        self._closed.set()


@hookimpl
def vioframe_sources() -> Mapping[str, SourceFactory]:
    return {"replay": Replay}
