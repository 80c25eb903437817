"""What a look at a recording comes to: findings, the cause ahead of what follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class Severity(StrEnum):
    """Whether a flight fails or suffers by it, or does well to know of it."""

    WRONG = "wrong"
    WORTH_KNOWING = "worth knowing"


class Certainty(StrEnum):
    """How sure a finding is."""

    CERTAIN = "certain"
    LIKELY = "likely"
    POSSIBLE = "possible"


CAUSES: Mapping[str, str] = {
    "imu_missing": "no reading of the IMU",
    "images_missing": "no image",
    "unreadable": "images or readings that cannot be read",
    "stamps_zero": "stamps of a sensor that are all the same",
    "stamp_units": "stamps in other units than nanoseconds",
    "clocks_apart": "clocks that overlap nowhere",
    "image_size": "images of another size than the calibration's",
    "imu_constant": "readings that never change, or are no numbers",
    "stamps_disorder": "stamps that go backwards or repeat",
    "stamps_bunched": "stamps of the IMU that come in bunches",
    "imu_rate": "an IMU too slow, or of another rate than the calibration says",
    "imu_gaps": "stretches without readings",
    "accel_units": "accelerations in other units than m/s^2",
    "gravity_missing": "accelerations without gravity",
    "gyro_units": "rates in other units than rad/s",
    "imu_mirrored": "axes that make a left-handed frame",
    "gyro_axes": "gyroscope and accelerometer with axes of their own",
    "gyro_saturated": "rates at the end of the gyroscope's range",
    "accel_saturated": "accelerations at the end of the accelerometer's range",
    "images_dark": "dark images",
    "images_bright": "overexposed images",
    "images_frozen": "images that repeat",
    "images_blurred": "blurred images",
    "texture": "images with little to hold on to",
    "frame_gaps": "stretches without images",
    "frame_rate": "few images a second",
    "gravity_size": "a gravity of odd size",
    "lever_arm": "a camera farther from the IMU than a vehicle is large",
    "rotation_transposed": "a camera's rotation on the body that is the inverse of the right one",
    "rotation_axes": "a camera's rotation, or the IMU's axes, off by quarter turns",
    "rotation": "a camera's rotation on the body that is off",
    "clock_drift": "an offset of the clocks that changes",
    "time_offset": "an offset of the clocks other than the one given",
    "focal_length": "a focal length other than the one given",
    "distortion": "a distortion other than the one given",
    "rolling_shutter": "rows that are exposed one after the other",
    "noise_density": "noise far from the densities given",
    "motion": "too little motion to begin, or to tell the rest",
}
"""The kinds of findings and what each is about, a cause ahead of what it makes look wrong: the order of the report."""

_DEPTH = {kind: depth for depth, kind in enumerate(CAUSES)}
_SURENESS = {certainty: place for place, certainty in enumerate(Certainty)}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing about a recording that is not as it should be.

    ``kind`` is one of :data:`CAUSES`; ``sentence`` says it with its figure, and ``remedy`` what to do: the line to put
    into the calibration, or the option to set. ``figures`` are what was measured, names ending in their units.
    """

    kind: str
    sentence: str
    remedy: str
    severity: Severity = Severity.WRONG
    certainty: Certainty = Certainty.CERTAIN
    figures: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        sure = "" if self.certainty is Certainty.CERTAIN else f" ({self.certainty})"
        return f"{self.sentence}{sure}; {self.remedy}"


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """What is wrong first, and of that the causes ahead of what follows from them."""
    return tuple(
        sorted(findings, key=lambda f: (f.severity is not Severity.WRONG, _DEPTH[f.kind], _SURENESS[f.certainty]))
    )
