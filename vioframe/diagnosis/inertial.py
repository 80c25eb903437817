"""The IMU by itself: units, gravity, saturation, noise, and whether both sensors share their axes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vioframe.diagnosis.findings import Certainty, Finding, Severity
from vioframe.diagnosis.recording import ImuSamples, Recording
from vioframe.diagnosis.stamps import rate_hz
from vioframe.estimation.inertial.noise import roughness
from vioframe.types import GRAVITY_M_S2, NS_PER_S, Float, ImuNoise

# Over half a second vibration averages out and gravity does not.
_SMOOTHED_S = 0.5
# Lengths of the specific force, m/s^2, that are gravity's in the unit of the key; free fall is less than ...
_IN_G, _MOST_WITHOUT_GRAVITY = (0.85, 1.15), 4.0
_STEADY = 0.25
_ODD_GRAVITY, _WRONG_GRAVITY = 0.35, 1.5
# Rates that no vehicle keeps up on average, rad/s.
_FASTEST_MEAN_RATE = 6.0
# A range is met where its end is read so many times in a row, and is beyond what is read at rest.
_RUN, _FEWEST_SATURATED, _LEAST_RATE_END, _LEAST_FORCE_END = 3, 6, 0.8, 12.0
# Of density that the quietest seconds show over the one given; EuRoC's rotors make 23 of it.
_TOO_NOISY, _TOO_QUIET = 60.0, 1.0 / 20.0
_NOISE_WINDOW_S = 0.5


def look_at_imu(recording: Recording) -> list[Finding]:
    """What is wrong with the readings, whatever the images say."""
    imu = recording.imu.sorted()
    if len(imu.t_ns) < 20 or imu.t_ns[-1] == imu.t_ns[0]:
        return [*_constant(recording)]
    return [*_constant(recording), *_forces(imu), *_rates(imu), *_saturated(imu), *_noise(imu, recording)]


def times_as_rough(imu: ImuSamples, given: ImuNoise) -> tuple[float, float]:
    """How many times as rough as by their densities gyroscope and accelerometer are, in the middle half second of all.

    By so much vibration is told from noise; in flight no more is counted with than so many times the density as
    ``gyro_noise_factor`` and ``accel_noise_factor`` say, and the walk as ``accel_walk_factor`` does.
    """
    width = max(10, round(_NOISE_WINDOW_S * rate_hz(imu.t_ns)))
    stretches = [slice(begin, begin + width) for begin in range(0, len(imu.t_ns) - width + 1, width)]

    def times(values: Float, density: float) -> float:
        rough = [roughness(imu.t_ns[stretch], values[stretch]) for stretch in stretches]
        return float(np.median(rough)) / density if rough else 0.0

    return times(imu.gyro_B, given.gyro_density), times(imu.accel_B, given.accel_density)


def smoothed(values: Float, rate: float) -> Float:
    """(N, 3) means over half a second, without the ends."""
    width = max(1, min(round(_SMOOTHED_S * rate), len(values)))
    total = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
    return np.asarray((total[width:] - total[:-width]) / width)


def _constant(recording: Recording) -> Iterator[Finding]:
    imu = recording.imu
    for name, values in (("gyroscope", imu.gyro_B), ("accelerometer", imu.accel_B)):
        if len(values) < 20:
            continue
        unusable = float((~np.isfinite(values).all(axis=1)).mean())
        if unusable > 0.01:
            yield Finding(
                "imu_constant",
                f"{unusable:.0%} of the {name}'s readings are no finite numbers",
                "they are dropped; see why the driver writes them",
                figures={"share": unusable},
            )
        elif len(stuck := [axis for axis in range(3) if np.ptp(values[:, axis]) == 0.0]):
            axes = ", ".join("xyz"[axis] for axis in stuck)
            yield Finding(
                "imu_constant",
                f"the {name}'s {axes} never changes: always {values[0, stuck[0]]:g}",
                "see whether the driver fills this field of its message",
                figures={"axes": len(stuck)},
            )


def _forces(imu: ImuSamples) -> Iterator[Finding]:
    length = np.linalg.norm(smoothed(imu.accel_B, rate_hz(imu.t_ns)), axis=1)
    usual = float(np.median(length))
    spread = float(np.percentile(length, 75.0) - np.percentile(length, 25.0)) / max(usual, 1e-9)
    figures = {"usual_length": usual}
    if usual == 0.0:
        return
    for unit, factor in (("g", GRAVITY_M_S2), ("milli-g", 1e-3 * GRAVITY_M_S2), ("cm/s^2", 0.01), ("mm/s^2", 0.001)):
        if _IN_G[0] < usual * factor / GRAVITY_M_S2 < _IN_G[1] and spread < _STEADY:
            yield Finding(
                "accel_units",
                f"accelerations are in {unit}: their length is {usual:.2f} where gravity's is {GRAVITY_M_S2} m/s^2",
                f"multiply them by {factor:g} where the recording is written; they must be in m/s^2",
                figures=figures,
            )
            return
    if usual < _MOST_WITHOUT_GRAVITY:
        yield Finding(
            "gravity_missing",
            f"accelerations lack gravity: their usual length is {usual:.2f} m/s^2 instead of {GRAVITY_M_S2}",
            "record the raw accelerometer (specific force), not the linear acceleration that a driver or an "
            "orientation filter has taken gravity out of",
            figures=figures,
        )
    elif abs(usual - GRAVITY_M_S2) > _ODD_GRAVITY:
        yield Finding(
            "gravity_size",
            f"the accelerometer's usual length is {usual:.2f} m/s^2 instead of {GRAVITY_M_S2}",
            "calibrate its scale and bias (six positions at rest), or check its range setting",
            Severity.WRONG if abs(usual - GRAVITY_M_S2) > _WRONG_GRAVITY else Severity.WORTH_KNOWING,
            Certainty.LIKELY,
            figures,
        )


def _rates(imu: ImuSamples) -> Iterator[Finding]:
    usual = float(np.sqrt((smoothed(imu.gyro_B, rate_hz(imu.t_ns)) ** 2).sum(axis=1).mean()))
    if usual > _FASTEST_MEAN_RATE:
        yield gyro_in_degrees(f"the body would turn at {usual:.0f} rad/s all the time", Certainty.LIKELY)


def gyro_in_degrees(why: str, certainty: Certainty = Certainty.CERTAIN) -> Finding:
    return Finding(
        "gyro_units",
        f"angular rates are in deg/s: {why}",
        "multiply them by 0.0174533 (pi / 180) where the recording is written; they must be in rad/s",
        certainty=certainty,
    )


def _saturated(imu: ImuSamples) -> Iterator[Finding]:
    for kind, name, values, least, unit, range_unit, factor in (
        ("gyro_saturated", "gyroscope", imu.gyro_B, _LEAST_RATE_END, "rad/s", "deg/s", 180.0 / np.pi),
        ("accel_saturated", "accelerometer", imu.accel_B, _LEAST_FORCE_END, "m/s^2", "g", 1.0 / GRAVITY_M_S2),
    ):
        for axis in range(3):
            end = float(np.abs(values[:, axis]).max())
            at_end = np.abs(values[:, axis]) >= end * (1.0 - 1e-6)
            runs = at_end[2:] & at_end[1:-1] & at_end[:-2]
            if end < least or at_end.sum() < _FEWEST_SATURATED or not runs.any():
                continue
            seconds = float(at_end.mean()) * (imu.t_ns[-1] - imu.t_ns[0]) / NS_PER_S
            yield Finding(
                kind,
                f"the {name}'s {'xyz'[axis]} is at the end of its range, {end:.3g} {unit} ({end * factor:.3g} "
                f"{range_unit}), {at_end.sum()} times ({seconds:.2f} s)",
                "set a larger range in its driver; what is beyond it is lost",
                figures={"end": end, "readings": float(at_end.sum())},
            )
            break


def _noise(imu: ImuSamples, recording: Recording) -> Iterator[Finding]:
    """By differences from one reading to the next, which motion hardly enters, in the quietest stretches."""
    hz, noise = rate_hz(imu.t_ns), recording.calibration.imu
    width = max(10, round(_NOISE_WINDOW_S * hz))
    for name, values, given, keys in (
        ("gyroscope", imu.gyro_B, noise.gyro_density, ("gyroscope_noise_density", "rad/s/sqrt(Hz)")),
        ("accelerometer", imu.accel_B, noise.accel_density, ("accelerometer_noise_density", "m/s^2/sqrt(Hz)")),
    ):
        steps = np.diff(values, axis=0, n=2) / np.sqrt(6.0)
        count = len(steps) // width
        if not count:
            continue
        deviation = steps[: count * width].reshape(count, width, 3).std(axis=1).mean(axis=1)
        measured = float(np.percentile(deviation, 10.0)) / np.sqrt(hz)
        ratio = measured / given
        if measured == 0.0 or _TOO_QUIET < ratio < _TOO_NOISY:
            continue
        times = f"{ratio:.0f} times" if ratio > 1.0 else f"one {1.0 / ratio:.0f}th of"
        yield Finding(
            "noise_density",
            f"the {name}'s noise in its quietest seconds is {measured:.2g} {keys[1]}, {times} the density given",
            f"check the unit of the data sheet's figure; `{keys[0]}: {measured:.2g}` fits this recording",
            Severity.WRONG,
            Certainty.LIKELY,
            {"density": measured, "given": given},
        )
