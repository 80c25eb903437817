"""Camera and IMU against each other: what is planted into a good flight is named first, and nothing is said of it as it
is. Points are followed once: what is planted here is in readings and calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rendered_flight import CALIBRATION, rendered_flight

from vioframe.diagnosis import Diagnosis, Finding, Recording, diagnose, gather
from vioframe.diagnosis.recording import ImuSamples
from vioframe.diagnosis.self_calibration import FOCAL, OFFSET, ROTATION, Pairs, start_at
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.types import Float


@cache
def recording() -> Recording:
    return gather(rendered_flight().measurements, CALIBRATION)


def with_imu(gyro: Float, accel: Float, late_ms: float = 0.0) -> Recording:
    """The gyroscope's and accelerometer's readings in axes of their own, or late."""
    imu = recording().imu
    changed = ImuSamples(imu.t_ns + round(1e6 * late_ms), imu.gyro_B @ gyro.T, imu.accel_B @ accel.T)
    return replace(recording(), imu=changed)


def with_camera(**changes: object) -> Recording:
    return replace(recording(), calibration=CALIBRATION.with_camera(0, **changes))


CAMERA = CALIBRATION.cameras[0]
ONE = np.eye(3)
MIRROR, CYCLE = np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 2, 0]]
FLIP = np.diag([-1.0, -1.0, 1.0])
TILT = so3.exp(np.deg2rad(10.0) * np.array([0.6, 0.64, -0.48]))

PLANTED: dict[str, tuple[str, Callable[[], Recording]]] = {
    "rates in deg/s": ("gyro_units", lambda: with_imu(np.rad2deg(ONE), ONE)),
    "rates ten times too large": ("gyro_units", lambda: with_imu(10.0 * ONE, ONE)),
    "IMU mirrored": ("imu_mirrored", lambda: with_imu(MIRROR, MIRROR)),
    "IMU turned": ("rotation_axes", lambda: with_imu(FLIP, FLIP)),
    "gyroscope turned": ("gyro_axes", lambda: with_imu(CYCLE, ONE)),
    "rotation inverted": ("rotation_transposed", lambda: with_camera(R_BC=CAMERA.R_BC.T)),
    "rotation 10 deg off": ("rotation", lambda: with_camera(R_BC=CAMERA.R_BC @ TILT)),
    "lever arm in mm": ("lever_arm", lambda: with_camera(p_BC=1e3 * CAMERA.p_BC)),
    "late by 40 ms": ("time_offset", lambda: with_imu(ONE, ONE, 40.0)),
    "early by 150 ms": ("time_offset", lambda: with_imu(ONE, ONE, -150.0)),
}


def first(found: Diagnosis) -> Finding:
    return found.findings[0]


def test_nothing_is_wrong_with_the_flight_as_it_is():
    found = diagnose(recording())
    assert not found.wrong, found.wrong
    assert "rotation" in found.facts["camera to IMU"]


@pytest.mark.parametrize("fault", PLANTED)
def test_the_cause_is_named_ahead_of_what_follows_from_it(fault):
    kind, plant = PLANTED[fault]
    found = diagnose(plant())
    assert first(found).kind == kind, found.findings
    assert found.wrong


def test_the_remedy_is_the_line_to_write():
    late = first(diagnose(with_imu(ONE, ONE, 40.0)))
    assert late.figures["offset_ms"] == pytest.approx(40.0, abs=3.0)
    assert f"`timeshift_cam_imu: {1e-3 * late.figures['offset_ms']:.4f}`" in late.remedy
    off = first(diagnose(with_camera(R_BC=CAMERA.R_BC @ TILT)))
    assert off.figures["off_deg"] == pytest.approx(10.0, abs=1.0)
    written = np.fromstring(off.remedy.partition("data: [")[2].partition("]")[0], sep=",").reshape(4, 4)
    assert np.rad2deg(np.linalg.norm(so3.log(written[:3, :3].T @ CAMERA.R_BC))) < 1.5
    np.testing.assert_allclose(written[:3, 3], CAMERA.p_BC, atol=1e-5)


def test_what_was_undistorted_already_is_what_would_be_undistorted_anew(monkeypatch):
    imu = recording().imu.sorted()
    pairs = Pairs(recording().stretches, CAMERA, imu, 0.1).half(later=False)
    start = start_at(CAMERA, CAMERA.R_BC @ TILT, np.zeros(3), 0.0)
    once = pairs.calibrate(start, (ROTATION, OFFSET, FOCAL))
    monkeypatch.setattr(Camera, "__eq__", lambda self, other: False)
    anew = pairs.calibrate(start, (ROTATION, OFFSET, FOCAL))
    for name in ("R_BC", "bias_gyro_B", "cov"):
        np.testing.assert_array_equal(getattr(anew, name), getattr(once, name))
    assert (anew.offset_s, anew.log_focal, anew.cost) == (once.offset_s, once.log_focal, once.cost)


def test_a_rotation_that_nobody_knows_is_not_called_wrong():
    assert not diagnose(with_camera(R_BC=np.eye(3), rotation_known=False)).wrong
