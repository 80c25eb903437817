"""All looks at a recording together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.diagnosis.findings import Finding, Severity, ranked
from vioframe.diagnosis.geometry import look_at_geometry
from vioframe.diagnosis.images import look_at_images
from vioframe.diagnosis.inertial import look_at_imu, smoothed, times_as_rough
from vioframe.diagnosis.motion import look_at_motion, moving_windows
from vioframe.diagnosis.recording import Recording
from vioframe.diagnosis.self_calibration import OFFSET, ROTATION, SelfCalibration
from vioframe.diagnosis.stamps import look_at_stamps, overlap_s, rate_hz, span_s
from vioframe.geometry import so3
from vioframe.types import NS_PER_S, CameraOnBody

HOPELESS = {"imu_missing", "images_missing", "stamps_zero", "stamp_units", "clocks_apart"}
"""Kinds of findings with which there is nothing to compare camera and IMU by, nor to estimate from."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """``findings`` ranked, and ``facts``: what was looked at, each in a few words, by name."""

    findings: tuple[Finding, ...]
    facts: dict[str, str]

    @property
    def wrong(self) -> tuple[Finding, ...]:
        """The findings that a flight fails or suffers by."""
        return tuple(finding for finding in self.findings if finding.severity is Severity.WRONG)


def diagnose(recording: Recording) -> Diagnosis:
    """Look at all there is; of a recording without ``stretches`` all but the geometry, within milliseconds."""
    findings = [*look_at_imu(recording), *look_at_images(recording)]
    if recording.wrong_size is None:  # a reader stops at the first such image
        findings += look_at_stamps(recording)
    found = None
    if recording.wrong_size is None and not HOPELESS & {finding.kind for finding in findings}:
        findings += look_at_motion(recording)
        geometry = look_at_geometry(recording)
        found = geometry.found
        findings += geometry.findings
    # The same by two ways: what is more certain stays.
    unique: dict[str, Finding] = {}
    for finding in ranked(findings):
        unique.setdefault(finding.kind, finding)
    return Diagnosis(tuple(unique.values()), _facts(recording, found))


def _facts(recording: Recording, found: SelfCalibration | None) -> dict[str, str]:
    imu, look, camera = recording.imu.sorted(), recording.look, recording.calibration.cameras[0]
    facts = {}
    if len(imu.t_ns) > 2 and span_s(imu.t_ns) > 0.0:
        length = float(np.median(np.linalg.norm(smoothed(imu.accel_B, rate_hz(imu.t_ns)), axis=1)))
        facts["IMU"] = (
            f"{len(imu.t_ns)} readings at {rate_hz(imu.t_ns):.1f} Hz over {span_s(imu.t_ns):.1f} s, "
            f"specific force {length:.2f} m/s^2"
        )
        gyro, accel = times_as_rough(imu, recording.calibration.imu)
        facts["vibration"] = (
            f"gyroscope {gyro:.1f} times, accelerometer {accel:.1f} times as rough as its noise density"
        )
    if len(look.t_ns) > 2 and span_s(look.t_ns) > 0.0:
        width, height = camera.model.resolution
        facts[camera.name] = (
            f"{len(look.t_ns)} images of {width}x{height} at {rate_hz(look.t_ns):.1f} Hz over {span_s(look.t_ns):.1f} s"
        )
        if len(imu.t_ns):
            facts["both"] = f"{max(overlap_s(recording), 0.0):.1f} s together"
    t_s, moving = moving_windows(recording)
    if np.any(moving):
        facts["motion"] = f"from {t_s[int(np.argmax(moving))]:.1f} s on, in {np.mean(moving):.0%} of the time"
    if found is not None:
        facts["camera to IMU"] = _measured(found, camera)
    return facts


def _measured(found: SelfCalibration, camera: CameraOnBody) -> str:
    offset = f"time offset {1e3 * found.offset_s:.1f} +- {1e3 * found.sigma(OFFSET):.1f} ms"
    offset += f" (given {1e3 * camera.time_offset_ns / NS_PER_S:.1f})"
    if not camera.rotation_known:
        return offset
    off = np.rad2deg(np.linalg.norm(so3.log(found.R_BC.T @ camera.R_BC)))
    return f"{offset}, rotation {off:.1f} +- {np.rad2deg(found.sigma(ROTATION)):.1f} deg from the one given"
