"""Camera and IMU against each other: units and axes, rotation, time offset and its drift, lens, shutter, lever arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vioframe.diagnosis.alignment import Alignment, align, camera_turns
from vioframe.diagnosis.findings import Certainty, Finding, Severity
from vioframe.diagnosis.inertial import gyro_in_degrees
from vioframe.diagnosis.recording import ImuSamples, Recording
from vioframe.diagnosis.self_calibration import (
    DISTORTION,
    FOCAL,
    OFFSET,
    READOUT,
    ROTATION,
    Pairs,
    SelfCalibration,
    start_at,
)
from vioframe.diagnosis.stamps import overlap_s, rate_hz
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, DistortionModel
from vioframe.types import NS_PER_S, CameraOnBody, Float, FrameTracks

_DEGREE = np.pi / 180.0
_ALL = (ROTATION, OFFSET, FOCAL, DISTORTION, READOUT)
# The share of the gyroscope's motion that the camera's turns must explain before they are believed, and how much of it
# there must be, rad/s.
_EXPLAINED, _LEAST_TURNING = 0.5, 0.01
_IN_DEGREES, _ODD_SCALE = (35.0, 80.0), 2.0
# By how much a mirrored frame must explain more, and how much of the motion must be about the least turned axis.
_MIRRORED, _THIRD_TURN = 0.03, 0.1
# Differences from what was given that are told, and that are wrong; those beyond chance, standard deviations.
_SIGMAS = 5.0
_ROTATION_DEG, _WRONG_ROTATION_DEG, _QUARTER_TURN_DEG, _INVERSE_DEG = 2.5, 5.0, 8.0, 6.0
_OFFSET_S, _WRONG_OFFSET_S, _DRIFT_S = 0.008, 0.012, 0.008
_FOCAL = 0.07
# What a lens bends tracked points by: where somebody has measured a distortion, and where none is given.
_BEND_PX, _BEND_PX_OF_NONE = 4.0, 1.0
# What only a lens of another kind does, and by how much the cost must fall where its model is taken instead.
_BEND_PX_OF_ANOTHER, _FITS_BETTER = 8.0, 0.8
_READOUT_S, _LONGEST_READOUT_S = 0.006, 0.06
_LARGEST_ARM_M = 2.0
_FEWEST_PAIRS = 20
# Gravity as the accelerometer sees it turns as the gyroscope says: windows, and how much better other axes must do it.
_WINDOW_S, _BETTER = 0.5, 0.8


@dataclass(frozen=True, slots=True)
class Geometry:
    """What was found of the first camera: in ``found``, where there was motion enough, with ``findings``."""

    findings: tuple[Finding, ...]
    found: SelfCalibration | None = None


def look_at_geometry(recording: Recording) -> Geometry:
    """Compare the calibration given with what turns and tracks say; what cannot be told is left out."""
    camera, imu = recording.calibration.cameras[0], recording.imu.sorted()
    arm = tuple(_lever_arm(camera))
    if len(imu.t_ns) < 100 or not recording.stretches or overlap_s(recording) <= 0.0:
        return Geometry(arm)
    coarse = _coarse(recording.stretches, camera, imu)
    if coarse is None or coarse.explained < _EXPLAINED or coarse.turned_rad_s < _LEAST_TURNING:
        return Geometry(arm)
    findings = [*arm, *_units(coarse)]
    factor = 180.0 / np.pi if findings[len(arm) :] else 1.0
    imu = ImuSamples(imu.t_ns, imu.gyro_B / factor, imu.accel_B)
    if coarse.mirrored and _is_certain_of_handedness(coarse):
        return Geometry((*findings, _mirrored(coarse, imu, camera)))
    pairs = Pairs(recording.stretches, camera, imu, 0.1 + abs(coarse.offset_s))
    if len(pairs) < _FEWEST_PAIRS:
        return Geometry(tuple(findings))
    start = start_at(camera, so3.project(coarse.M), coarse.bias_gyro_B / factor, coarse.offset_s)
    found = pairs.calibrate(start, _ALL)
    lens = _lens(found, camera.model, pairs)
    if lens is not None and lens.figures["bend_px"] > _BEND_PX_OF_ANOTHER:
        # With a lens so different nothing else that was found can be believed.
        other = _with_other_model(recording.stretches, camera, imu, pairs)
        if other is None or not other.cost < _FITS_BETTER * found.cost:
            return Geometry((*findings, lens))
        found, lens = other, _as_other_model(camera.model)
    if lens is None:
        lens = _focal(found, camera.model, pairs)
    findings += [lens] if lens else []
    findings += _rotation(found, camera, imu)
    findings += _offset(found, camera)
    findings += _drift(found, pairs)
    findings += _shutter(found, camera)
    return Geometry(tuple(findings), found)


def _coarse(stretches: Sequence[Sequence[FrameTracks]], camera: CameraOnBody, imu: ImuSamples) -> Alignment | None:
    turns = camera_turns(stretches, 1.0 / camera.model.focal_px)
    return align(turns, imu, camera.time_offset_ns / NS_PER_S)


def _units(coarse: Alignment) -> Iterator[Finding]:
    if _IN_DEGREES[0] < coarse.scale < _IN_DEGREES[1]:
        yield gyro_in_degrees(f"the images turn {coarse.scale:.1f} times less than the gyroscope says")
    elif coarse.scale > _ODD_SCALE or (coarse.scale < 1.0 / _ODD_SCALE and coarse.explained > 0.9):
        yield Finding(
            "gyro_units",
            f"angular rates are {coarse.scale:.3g} times as large as the images turn",
            f"multiply them by {1.0 / coarse.scale:.3g}, or correct the driver's scale; they must be in rad/s",
            figures={"scale": coarse.scale},
        )


def _is_certain_of_handedness(coarse: Alignment) -> bool:
    return coarse.explained - coarse.other_explained > _MIRRORED and coarse.third_turn > _THIRD_TURN


def _mirrored(coarse: Alignment, imu: ImuSamples, camera: CameraOnBody) -> Finding:
    """The camera's turns and the gyroscope's are those of frames of different handedness."""
    D = min(so3.signed_permutations(-1), key=lambda D: float(np.linalg.norm(D @ camera.R_BC - coarse.M)))
    alone, names = _gyroscope_alone(imu, D), _say(D)
    return Finding(
        "gyro_axes" if alone else "imu_mirrored",
        f"the {'gyroscope' if alone else 'IMU'}'s axes make a left-handed frame: only mirrored do its turns fit the "
        f"images' ({coarse.explained:.0%} explained, {coarse.other_explained:.0%} otherwise)",
        f"beside the calibration given its axes are {names}: swap and negate them where the recording is written"
        + ("" if alone else ", of both sensors"),
        certainty=Certainty.CERTAIN,
        figures={"explained": coarse.explained, "otherwise": coarse.other_explained},
    )


def _rotation(found: SelfCalibration, camera: CameraOnBody, imu: ImuSamples) -> Iterator[Finding]:
    if not camera.rotation_known:
        return
    off = _angle_deg(found.R_BC, camera.R_BC)
    sigma = found.sigma(ROTATION) / _DEGREE
    if off < max(_ROTATION_DEG, _SIGMAS * sigma):
        return
    rows = ", ".join(f"{x:.5f}" for row in np.column_stack([found.R_BC, camera.p_BC]) for x in row)
    line = f"to {sigma:.1f} deg it is `T_BS: data: [{rows}, 0, 0, 0, 1]`"
    figures = {"off_deg": off, "sigma_deg": sigma}
    inverse = _angle_deg(found.R_BC, camera.R_BC.T)
    D = min(so3.signed_permutations(1), key=lambda D: _angle_deg(found.R_BC, D @ camera.R_BC))
    turned = _angle_deg(found.R_BC, D @ camera.R_BC)
    by_quarters = turned < min(_QUARTER_TURN_DEG, 0.5 * off) and not np.array_equal(D, np.eye(3))
    if inverse < min(_INVERSE_DEG, 0.5 * off) and not (by_quarters and turned < inverse - 1.0):
        yield Finding(
            "rotation_transposed",
            f"the camera's rotation is the inverse of the one given: that is off by {off:.0f} deg, its transpose by "
            f"{inverse:.1f}",
            "invert the transform: EuRoC's T_BS maps camera to IMU, Kalibr's T_cam_imu IMU to camera; or set "
            "`camera_rotation: unknown`",
            figures=figures,
        )
    elif by_quarters and _gyroscope_alone(imu, D):
        yield Finding(
            "gyro_axes",
            f"the gyroscope's axes are not the accelerometer's: beside them they are {_say(D)}",
            "write both in one frame; see the mounting matrices of the driver",
            figures=figures,
        )
    elif by_quarters:
        yield Finding(
            "rotation_axes",
            f"the camera's rotation or the axes of the IMU are off by quarter turns ({off:.0f} deg): as if the IMU's "
            f"were {_say(D)}",
            f"correct the one that is wrong; {line}",
            figures=figures,
        )
    else:
        yield Finding(
            "rotation",
            f"the camera's rotation on the body is {off:.1f} deg from the one given",
            f"{line}; or set `camera_rotation: unknown`",
            Severity.WRONG if off > _WRONG_ROTATION_DEG else Severity.WORTH_KNOWING,
            Certainty.CERTAIN if off > 2.0 * _SIGMAS * sigma else Certainty.LIKELY,
            figures,
        )


def _offset(found: SelfCalibration, camera: CameraOnBody) -> Iterator[Finding]:
    given = camera.time_offset_ns / NS_PER_S
    off, sigma = found.offset_s - given, found.sigma(OFFSET)
    if abs(off) > max(_OFFSET_S, _SIGMAS * sigma):
        yield Finding(
            "time_offset",
            f"the IMU's stamps are {1e3 * abs(found.offset_s):.1f} ms {'ahead of' if found.offset_s > 0 else 'behind'} "
            f"the camera's (+-{1e3 * sigma:.1f}), {1e3 * given:.1f} ms are given",
            f"`timeshift_cam_imu: {found.offset_s:.4f}` in the camera's calibration (t_imu = t_cam + shift)",
            Severity.WRONG if abs(off) > _WRONG_OFFSET_S else Severity.WORTH_KNOWING,
            Certainty.CERTAIN if abs(off) > 2.0 * _SIGMAS * sigma else Certainty.LIKELY,
            {"offset_ms": 1e3 * found.offset_s, "sigma_ms": 1e3 * sigma, "given_ms": 1e3 * given},
        )


def _drift(found: SelfCalibration, pairs: Pairs) -> Iterator[Finding]:
    halves = [pairs.half(later) for later in (False, True)]
    if min(map(len, halves)) < _FEWEST_PAIRS:
        return
    early, late = (half.calibrate(found, (OFFSET,)) for half in halves)
    apart_s = float(np.median(halves[1].t_s[:, 0]) - np.median(halves[0].t_s[:, 0]))
    change = late.offset_s - early.offset_s
    sigma = float(np.hypot(late.sigma(OFFSET), early.sigma(OFFSET)))
    if abs(change) > max(_DRIFT_S, _SIGMAS * sigma):
        yield Finding(
            "clock_drift",
            f"the clocks drift apart: the offset goes from {1e3 * early.offset_s:.1f} to {1e3 * late.offset_s:.1f} ms "
            f"in {apart_s:.0f} s ({1e6 * change / apart_s:.0f} ppm)",
            "stamp camera and IMU by one clock, or synchronise them while recording",
            Severity.WRONG,
            Certainty.LIKELY,
            {"change_ms": 1e3 * change, "sigma_ms": 1e3 * sigma, "over_s": apart_s},
        )


def _lens(found: SelfCalibration, given: Camera, pairs: Pairs) -> Finding | None:
    """A distortion other than the one given."""
    bend = _bend_px(given, found.camera, pairs.xy[:, pairs.common].reshape(-1, 2))
    of_none = not any(given.distortion) and given.distortion_model == "radtan"
    (k1, k2), (given_k1, given_k2) = found.camera.distortion[:2], given.distortion[:2]
    sigma = found.sigma(DISTORTION)
    if abs(k1 - given_k1) < _SIGMAS * sigma or bend < (_BEND_PX_OF_NONE if of_none else _BEND_PX):
        return None
    return Finding(
        "distortion",
        f"the lens distorts otherwise than given: tracked points are {bend:.1f} px off; k1 k2 of {k1:.3f} {k2:.3f} "
        f"(+-{sigma:.3f}) fit better than {given_k1:g} {given_k2:g}",
        "calibrate the camera, with Kalibr say",
        certainty=Certainty.LIKELY,
        figures={"bend_px": bend, "k1": k1, "k2": k2, "sigma": sigma},
    )


def _with_other_model(
    stretches: Sequence[Sequence[FrameTracks]], camera: CameraOnBody, imu: ImuSamples, pairs: Pairs
) -> SelfCalibration | None:
    """All anew, the coefficients taken for those of the other model."""
    other: DistortionModel = "equidistant" if camera.model.distortion_model == "radtan" else "radtan"
    camera = replace(camera, model=replace(camera.model, distortion_model=other))
    seen = [[tracks.undistorted(camera.model) for tracks in stretch] for stretch in stretches]
    coarse = _coarse(seen, camera, imu)
    if coarse is None or coarse.mirrored:
        return None
    return pairs.calibrate(start_at(camera, coarse.M, coarse.bias_gyro_B, coarse.offset_s), _ALL)


def _as_other_model(given: Camera) -> Finding:
    right = {"radtan": "equidistant", "equidistant": "radial-tangential"}[given.distortion_model]
    return Finding(
        "distortion",
        f"the lens distorts otherwise than given: the coefficients are those of another model, as {right} they fit",
        f"`distortion_model: {right}`" + (" (EuRoC), `equidistant` (Kalibr)" if right == "equidistant" else ""),
    )


def _focal(found: SelfCalibration, given: Camera, pairs: Pairs) -> Finding | None:
    """A focal length other than the one given, with the distortion that is: one may stand for the other."""
    if abs(found.log_focal) < 0.5 * _FOCAL:
        return None
    found = pairs.calibrate(replace(found, camera=given, log_focal=0.0), (ROTATION, OFFSET, FOCAL, READOUT))
    factor, sigma = float(np.exp(found.log_focal)), found.sigma(FOCAL)
    if abs(factor - 1.0) < max(_FOCAL, _SIGMAS * sigma):
        return None
    intrinsics = f"[{factor * given.fx:.1f}, {factor * given.fy:.1f}, {given.cx:.1f}, {given.cy:.1f}]"
    return Finding(
        "focal_length",
        f"the focal length is {abs(factor - 1.0):.0%} {'longer' if factor > 1.0 else 'shorter'} than the one given "
        "(or the gyroscope's scale is off by as much)",
        f"calibrate the camera; about `intrinsics: {intrinsics}`",
        certainty=Certainty.LIKELY,
        figures={"factor": factor, "sigma": sigma},
    )


def _shutter(found: SelfCalibration, camera: CameraOnBody) -> Iterator[Finding]:
    off, sigma = abs(found.readout_s - camera.readout_s), found.sigma(READOUT)
    if off > max(_READOUT_S, _SIGMAS * sigma) and abs(found.readout_s) < _LONGEST_READOUT_S:
        yield Finding(
            "rolling_shutter",
            f"the rows are exposed one after the other: {1e3 * found.readout_s:.0f} ms (+-{1e3 * sigma:.0f}) from the "
            f"first to the last, {1e3 * camera.readout_s:.0f} ms are given",
            f"`readout_time: {found.readout_s:.4f}` in the camera's calibration",
            certainty=Certainty.CERTAIN if off > 2.0 * _SIGMAS * sigma else Certainty.LIKELY,
            figures={"readout_ms": 1e3 * found.readout_s, "sigma_ms": 1e3 * sigma},
        )


def _lever_arm(camera: CameraOnBody) -> Iterator[Finding]:
    length = float(np.linalg.norm(camera.p_BC))
    if length > _LARGEST_ARM_M:
        in_mm = 1e-3 * length < _LARGEST_ARM_M
        yield Finding(
            "lever_arm",
            f"the camera is {length:.3g} m from the IMU by its calibration" + (": in millimetres" if in_mm else ""),
            f"give it in metres: {np.round(1e-3 * camera.p_BC, 6).tolist()}" if in_mm else "check T_BS or T_cam_imu",
            certainty=Certainty.CERTAIN if in_mm else Certainty.LIKELY,
            figures={"length_m": length},
        )


def _gyroscope_alone(imu: ImuSamples, D: Float) -> bool:
    """Whether the gyroscope's axes are ``D`` (3, 3) times those they should have, and the accelerometer's are right.

    Gravity stands still: seen from the body it changes over a window by accel x rate, acceleration averaging out. That
    holds for the gyroscope set right, or for both sensors in one frame, left-handed or not.
    """
    rate = rate_hz(imu.t_ns)
    width = max(2, round(_WINDOW_S * rate))
    if len(imu.t_ns) < 10 * width:
        return False
    totals = [np.cumsum(np.concatenate([np.zeros((1, 3)), v]), axis=0) for v in (imu.accel_B, imu.gyro_B)]
    accel, gyro = ((total[width:] - total[:-width]) / width for total in totals)
    gyro = gyro - np.median(gyro, axis=0)
    change = accel[width:] - accel[:-width]
    middle = slice(width // 2, width // 2 + len(change))

    def off(turned: Float) -> float:
        left = change - width / rate * np.cross(accel[middle], gyro[middle] @ turned.T)
        return float(np.median((left * left).sum(axis=1)))

    return off(D.T) < _BETTER * off(np.eye(3) * np.linalg.det(D))


def _say(D: Float) -> str:
    """Rows of a signed permutation as axes: ``(y, -x, z)``."""
    names = []
    for row in D:
        axis = int(np.argmax(np.abs(row)))
        names.append(("-" if row[axis] < 0 else "") + "xyz"[axis])
    return f"({', '.join(names)})"


def _angle_deg(R: Float, other: Float) -> float:
    return float(np.linalg.norm(so3.log(R.T @ other))) / _DEGREE


def _bend_px(given: Camera, found: Camera, xy: Float) -> float:
    """How far the two models put pixels ``xy`` (N, 2) apart, px rms, beside a factor of the focal length."""
    one, other = given.undistort(xy), found.undistort(xy)
    good = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    one, other = one[good], other[good]
    if len(one) < 10:
        return np.inf
    factor = float((one * other).sum() / (other * other).sum())
    return given.focal_px * float(np.sqrt(((one - factor * other) ** 2).sum(axis=1).mean()))
