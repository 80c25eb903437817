"""Stamps and clocks: units, order, overlap, rates, bunches and gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vioframe.diagnosis.findings import Certainty, Finding, Severity
from vioframe.diagnosis.recording import Recording
from vioframe.types import NS_PER_S, Float, Int

# Periods beyond so many usual ones are gaps; those of the IMU that begin everything anew, and those that lose tracks.
_IMU_GAP_PERIODS, _FRAME_GAP_PERIODS = 5.0, 1.8
_LONG_IMU_GAP_S, _LONG_FRAME_GAP_S, _LOST_FRAMES = 0.1, 0.5, 0.1
# A reading whose stamp is this near to the one before, in mean periods, shares a bunch with it.
_BUNCHED, _MOST_BUNCHED = 0.1, 0.3
_SLOWEST_IMU_HZ, _SLOW_IMU_HZ, _SLOW_CAMERA_HZ = 50.0, 90.0, 7.0
# No IMU and no camera is faster, Hz.
_FASTEST_IMU_HZ, _FASTEST_CAMERA_HZ = 20_000.0, 2_000.0
_UNITS = {1_000: "microseconds", 1_000_000: "milliseconds", 1_000_000_000: "seconds"}
_FEWEST = 3


def look_at_stamps(recording: Recording) -> list[Finding]:
    """What is wrong with the stamps; where nothing came of a sensor, that is all there is to say."""
    imu_ns, frames_ns = recording.imu.t_ns, recording.look.t_ns
    found = [*_missing(recording), *_stuck(imu_ns, frames_ns)]
    if found:
        return found
    found = [*_units(imu_ns, frames_ns)] or [*_apart(recording)]
    pace = [*_imu_pace(recording)]
    found += pace
    # Stamps of a bunch are often all the same.
    if not any(finding.kind == "stamps_bunched" for finding in pace):
        found += _disorder("the IMU", imu_ns)
    found += _disorder("the camera", frames_ns)
    found += _frame_pace(frames_ns)
    return found


def span_s(t_ns: Int) -> float:
    """From the first to the last of ``t_ns``, in any order."""
    return float(t_ns.max() - t_ns.min()) / NS_PER_S


def overlap_s(recording: Recording) -> float:
    """How long both camera and IMU speak, on the IMU's clock; negative is the time between them."""
    imu_ns = recording.imu.t_ns
    frames_ns = recording.look.t_ns + recording.calibration.cameras[0].time_offset_ns
    return float(min(imu_ns.max(), frames_ns.max()) - max(imu_ns.min(), frames_ns.min())) / NS_PER_S


def rate_hz(t_ns: Int) -> float:
    """By the usual period: gaps do not lower it, bunches do not raise it."""
    periods = _periods(np.unique(t_ns))
    mean = float(periods.mean())
    usual = float(np.median(periods))
    return NS_PER_S / (mean if _bunched_share(periods) > _MOST_BUNCHED else usual)


def _missing(recording: Recording) -> Iterator[Finding]:
    for count, kind, what, unreadable in (
        (len(recording.imu.t_ns), "imu_missing", "readings of the IMU", "imu_unreadable"),
        (len(recording.look.t_ns), "images_missing", "images", "frame_unreadable"),
    ):
        if count >= _FEWEST:
            continue
        remedy = "record both, or name the right topic with the reader's options (`vioframe plugins READER`)"
        if recording.unreadable[unreadable]:
            what, remedy = f"{what} that can be read", "copy the recording again, or look at its disk"
        yield Finding(kind, f"there are {count or 'no'} {what}", remedy)


def _stuck(imu_ns: Int, frames_ns: Int) -> Iterator[Finding]:
    for name, t_ns in (("IMU", imu_ns), ("camera", frames_ns)):
        if len(t_ns) >= _FEWEST and len(np.unique(t_ns)) <= max(1, len(t_ns) // 100):
            value = int(np.median(t_ns))
            yield Finding(
                "stamps_zero",
                f"all {len(t_ns)} stamps of the {name} are {value}",
                "have the driver stamp its messages (header.stamp) when they are measured, and record again",
                figures={"stamps": len(t_ns)},
            )


def _units(imu_ns: Int, frames_ns: Int) -> Iterator[Finding]:
    """A sensor that is impossibly fast has its stamps in larger units than they are taken for."""
    if len(imu_ns) < _FEWEST or len(frames_ns) < _FEWEST:
        return
    for name, t_ns, other_ns, fastest in (
        ("IMU", imu_ns, frames_ns, _FASTEST_IMU_HZ),
        ("camera", frames_ns, imu_ns, _FASTEST_CAMERA_HZ),
    ):
        hz = (len(t_ns) - 1) / max(span_s(t_ns), 1e-9)
        if hz < fastest:
            continue
        # Both sensors tell the same time of the day, or at least the same length.
        ratio = span_s(other_ns) / max(span_s(t_ns), 1e-9)
        if t_ns.min() > 0 and other_ns.min() / t_ns.min() > 500.0:
            ratio = float(other_ns.min() / t_ns.min())
        factor = min(_UNITS, key=lambda unit: abs(np.log(unit / ratio)))
        yield Finding(
            "stamp_units",
            f"the {name}'s stamps are in {_UNITS[factor]}: as nanoseconds they make a rate of {hz:.3g} Hz",
            f"multiply them by {factor:_}; stamps are integer nanoseconds",
            figures={"rate_hz": hz, "factor": factor},
        )


def _apart(recording: Recording) -> Iterator[Finding]:
    imu_ns, frames_ns = recording.imu.t_ns, recording.look.t_ns
    if not (len(imu_ns) and len(frames_ns)):
        return
    common_s = overlap_s(recording)
    spans = " and ".join(
        f"the {name} from {t_ns.min() / NS_PER_S:.3f} to {t_ns.max() / NS_PER_S:.3f} s"
        for name, t_ns in (("camera speaks", frames_ns), ("IMU", imu_ns))
    )
    between_s = float(imu_ns.min() - frames_ns.min()) / NS_PER_S
    if common_s <= 0.0:
        yield Finding(
            "clocks_apart",
            f"the stamps of camera and IMU overlap nowhere: {spans}",
            "stamp both by one clock; or, where they began together, give the difference of the clocks: "
            f"`timeshift_cam_imu: {between_s:.6f}` (Kalibr), t_imu = t_cam + timeshift",
            figures={"apart_s": -common_s, "between_beginnings_s": between_s},
        )
    elif common_s < 0.5 * span_s(frames_ns):
        yield Finding(
            "clocks_apart",
            f"the IMU covers {common_s:.1f} of the camera's {span_s(frames_ns):.1f} s: {spans}",
            "frames without readings are dropped; if both ran all the time their clocks differ",
            Severity.WRONG,
            Certainty.LIKELY,
            {"overlap_s": common_s},
        )


def _disorder(name: str, t_ns: Int) -> Iterator[Finding]:
    steps = np.diff(t_ns)
    backwards, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    share = (backwards + repeated) / max(len(steps), 1)
    if not share:
        return
    yield Finding(
        "stamps_disorder",
        f"{backwards} stamps of {name} go backwards and {repeated} repeat the one before, of {len(t_ns)}",
        "those that come too late or twice are dropped; have the driver stamp at the measurement, not at the arrival",
        Severity.WRONG if share > 0.05 else Severity.WORTH_KNOWING,
        figures={"backwards": backwards, "repeated": repeated},
    )


def _periods(t_ns: Int) -> Int:
    return np.asarray(t_ns[1:] - t_ns[:-1])


def _bunched_share(periods: Int) -> float:
    """Of periods far below the mean."""
    return float((periods < _BUNCHED * periods.mean()).mean()) if len(periods) else 0.0


def _imu_pace(recording: Recording) -> Iterator[Finding]:
    t_ns = np.unique(recording.imu.t_ns)
    if len(t_ns) < _FEWEST or span_s(t_ns) == 0.0:
        return
    periods: Float = np.diff(t_ns) / NS_PER_S
    raw = _periods(np.sort(recording.imu.t_ns))
    bunched = _bunched_share(raw)
    if bunched > _MOST_BUNCHED:
        longest = float(np.percentile(periods, 95.0))
        yield Finding(
            "stamps_bunched",
            f"the IMU's stamps come in bunches: {bunched:.0%} follow the one before at once, and then nothing for "
            f"{1e3 * longest:.0f} ms",
            "have the driver stamp each reading when it is measured, not when its packet arrives; the mean rate of "
            f"{(len(raw)) / span_s(t_ns):.0f} Hz tells the spacing",
            figures={"bunched_share": bunched, "pause_ms": 1e3 * longest},
        )
        return
    hz, told = rate_hz(t_ns), recording.calibration.imu.rate_hz
    if hz < _SLOW_IMU_HZ:
        yield Finding(
            "imu_rate",
            f"the IMU gives {hz:.0f} readings a second; motion between them is lost",
            "set its driver to 100 Hz or more (200 Hz is usual)",
            Severity.WRONG if hz < _SLOWEST_IMU_HZ else Severity.WORTH_KNOWING,
            figures={"rate_hz": hz},
        )
    elif not 0.7 < hz / told < 1.4:
        yield Finding(
            "imu_rate",
            f"the IMU gives {hz:.0f} readings a second, the calibration says {told:g}",
            f"`rate_hz: {hz:.0f}` (EuRoC) or `update_rate: {hz:.0f}` (Kalibr)",
            Severity.WORTH_KNOWING,
            figures={"rate_hz": hz, "given_hz": told},
        )
    gaps = periods[periods > _IMU_GAP_PERIODS / hz]
    if len(gaps):
        yield Finding(
            "imu_gaps",
            f"{len(gaps)} times the IMU says nothing for more than {_IMU_GAP_PERIODS:g} periods, "
            f"the longest {1e3 * gaps.max():.0f} ms",
            "look for a full bus or disk while recording; beyond 100 ms an initialisation begins anew",
            Severity.WRONG if gaps.max() > _LONG_IMU_GAP_S else Severity.WORTH_KNOWING,
            figures={"gaps": len(gaps), "longest_ms": 1e3 * float(gaps.max())},
        )


def _frame_pace(t_ns: Int) -> Iterator[Finding]:
    t_ns = np.unique(t_ns)
    if len(t_ns) < _FEWEST:
        return
    hz = rate_hz(t_ns)
    periods = np.diff(t_ns) / NS_PER_S
    gaps = periods[periods > _FRAME_GAP_PERIODS / hz]
    missing = float(np.maximum(np.round(periods * hz) - 1, 0).sum())
    share = missing / (len(t_ns) + missing)
    if len(gaps):
        grave = share > _LOST_FRAMES or gaps.max() > _LONG_FRAME_GAP_S
        yield Finding(
            "frame_gaps",
            f"{missing:.0f} frames ({share:.0%}) are missing at {hz:.0f} Hz, the longest gap is {gaps.max():.2f} s",
            "record to a faster disk, or fewer or smaller images; tracks are lost over gaps",
            Severity.WRONG if grave else Severity.WORTH_KNOWING,
            figures={"missing": missing, "missing_share": share, "longest_s": float(gaps.max())},
        )
    if hz < _SLOW_CAMERA_HZ:
        yield Finding(
            "frame_rate",
            f"the camera gives {hz:.1f} images a second; points are hard to follow from one to the next",
            "set it to 10 to 30 Hz",
            Severity.WORTH_KNOWING,
            figures={"rate_hz": hz},
        )
