"""Finds where an estimator may begin, one frame at a time."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from vioframe.arrays import Float
from vioframe.estimation import rig
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, INTRINSICS, OFFSET, READOUT
from vioframe.estimation.inertial.noise import roughness
from vioframe.estimation.inertial.readings import Readings
from vioframe.estimation.initialization import dynamic, static, stereo
from vioframe.estimation.initialization.found import Found, found_by
from vioframe.estimation.initialization.sensors import SensorCheck
from vioframe.estimation.initialization.window import (
    LARGEST_IMU_GAP_S,
    ContradictedError,
    InitialEstimate,
    Packet,
    RefusalError,
    UnsureError,
    linked,
    refuse_unless,
    seen_anew,
    unrolled,
)
from vioframe.estimation.options import EstimationOptions
from vioframe.geometry import so3
from vioframe.types import (
    NS_PER_S,
    Calibration,
    CalibrationEstimate,
    CameraSigma,
    FrameTracks,
    ImuNoise,
    ImuSegment,
)

_log = logging.getLogger("vioframe.estimation.initialization")

# Length of the standstill that the static method needs.
_STATIC_WINDOW_S = 1.0
# Lengths of what a rig that sees depth begins from.
_SHORTEST_STEREO_S, _LONGEST_STEREO_S = 0.44, 1.5
# The dynamic method is first tried when the window is this long, and looks back no farther than this; every so often.
_SHORTEST_WINDOW_S, _USUAL_WINDOW_S, _LONGEST_WINDOW_S, _LONGER = 1.5, 3.0, 10.0, 1.2
# Each attempt that is refused puts the next off by so much more, up to a longest wait.
_SOON_S, _LATER_S, _LATEST_S = 0.1, 0.05, 0.6
# Times the white noise given in the dynamic method, which has no later readings to correct what vibration, scale and
# alignment errors do over its seconds: with 8 its squared errors on EuRoC's flights are as its covariance says.
# Readings that are smoother than their calibration has it count as such: this many times what they jump by.
_IN_MOTION, _JUMPS = 8.0, 2.5
# What a calibration may be off by before a start has borne it out, beyond how well it is known: rad, s and relative.
# What contradicts it is taken over so many times in one attempt.
_DOUBT_ROTATION, _DOUBT_OFFSET_S, _DOUBT_FOCAL, _DOUBT_READOUT_S = 0.05, 0.02, 0.06, 0.015
_MOST_CONTRADICTIONS = 3
# What the frames of a start tell of the calibration would count twice as a prior for it: made so many times weaker.
_WITHOUT_ITS_FRAMES = 2.0
# A camera that is turned by more than this on the body, rad, no back-end finds by itself.
_MOUNTED_DIFFERENTLY = np.deg2rad(15.0)
GIVEN = EstimationOptions().camera_sigma
"""How well the calibration of a camera is known unless somebody says otherwise."""


class Initializer:
    """Tries the static method at every frame, and the dynamic one every so often, until one is sure of itself.

    Ahead of the dynamic method time offset, the camera's rotation on the body, its focal length and readout are held
    against what turns of camera and gyroscope say, and others found in their place where they do not fit, or are not
    known. With a rig whose cameras overlap a start by stereo comes ahead of it; all else looks at the first camera.
    Every attempt is logged to ``vioframe.estimation.initialization``.
    """

    def __init__(self, calibration: Calibration, sigma: CameraSigma = GIVEN) -> None:
        """``sigma`` is how well each camera of ``calibration`` is known."""
        self._given, self._given_sigma = calibration, sigma
        self._calibration = calibration.only(0)
        self._sensors = SensorCheck()
        self._found: Found | None = None
        self._refusals: dict[str, str] = {}
        self._readings = Readings()
        self._packets: list[Packet] = []
        self._linked_ns = 0
        self._waiting: list[FrameTracks] = []
        self._of_rig: list[Packet] = []
        self.in_doubt = False
        """Whether a start was made that bears out nothing of the calibration: at rest, or by stereo."""
        self._begin_waiting()

    def _begin_waiting(self) -> None:
        self._window_s, self._wait_s, self._next_attempt_ns = _USUAL_WINDOW_S, _SOON_S - _LATER_S, 0
        self._next_stereo_ns = 0

    @property
    def calibration(self) -> Calibration:
        """That of the sensors, with what was found in place of what was given."""
        return self._given.moved_with(self._calibration.cameras[0])

    @property
    def found(self) -> Found | None:
        """What was found to fit better than the calibration given, last; None where that fits."""
        return self._found

    @property
    def camera_sigma(self) -> CameraSigma:
        """How well the camera's calibration is known."""
        return self._sigma()

    @property
    def refusal(self) -> str:
        """Why the last attempt of each method came to nothing, in one line; "" before the first and after a success."""
        return "; ".join(f"{method}: {reason}" for method, reason in self._refusals.items())

    def reset(self) -> None:
        """Forget everything seen, but not what was found of the calibration."""
        self._sensors.reset()
        self._readings = Readings()
        self._packets.clear()
        self._waiting.clear()
        self._of_rig.clear()
        self._refusals.clear()
        self.in_doubt = False
        self._begin_waiting()

    def add(self, imu: ImuSegment, tracks: FrameTracks, time_offset_ns: int | None = None) -> InitialEstimate | None:
        """Take one frame; an estimate whose newest state is at this frame, or None as long as none can be trusted.

        ``imu`` counts with ``time_offset_ns``, or with that of :attr:`calibration`, and begins where that of the call
        before ended on the IMU's own clock, or earlier. Nothing begins at a frame whose readings still count with
        another time offset than that, nor at one that the first camera has no part in.
        """
        due_ns = self._calibration.cameras[0].time_offset_ns
        late_ns = 0 if time_offset_ns is None else due_ns - time_offset_ns
        if late_ns:
            self._take(replace(imu, t_ns=imu.t_ns - late_ns), tracks)
            return None
        taken = self._take(imu, tracks)
        if taken or tracks.by_others_alone:
            self._take_of_rig(imu, tracks)
        if not taken:
            return None
        known = self._calibration.cameras[0].rotation_known
        placed = {"static": self._static, "stereo": self._stereo} if known else {}
        methods = {**placed, "dynamic": self._dynamic}
        for method, attempt in methods.items():
            try:
                estimate = attempt()
            except (RefusalError, np.linalg.LinAlgError) as refusal:
                self._refusals[method] = str(refusal)
                _log.debug("%d %s refused: %s", tracks.t_ns, method, refusal)
                continue
            if estimate is not None:
                _log.info("%d %s initialisation accepted", tracks.t_ns, method)
                self._refusals.clear()
                self.in_doubt = estimate.method != "dynamic"
                return estimate
        return None

    def follow(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> bool:
        """Take one frame of a flight that began at rest; whether the camera turns out to be mounted quite differently.

        That is :attr:`found` then, and the frames so far are those of the next start; what is off by less a back-end
        finds by itself. To be called as long as it is :attr:`in_doubt`.
        """
        if not self._take(imu, tracks) or still or tracks.t_ns < self._next_attempt_ns:
            return False
        self._next_attempt_ns = tracks.t_ns + round(_LATEST_S * NS_PER_S)
        try:
            found = self._sensors.judge(self._readings, self._calibration)
        except RefusalError:
            return False
        if found is None:
            self.in_doubt = not self._sensors.bear_out(self._readings, self._calibration)
            return False
        (given,), (camera,) = self._calibration.cameras, found.calibration.cameras
        if not np.linalg.norm(so3.log(given.R_BC.T @ camera.R_BC)) > _MOUNTED_DIFFERENTLY:
            return False
        self._take_over(found)
        self._begin_waiting()
        return True

    def _take(self, imu: ImuSegment, tracks: FrameTracks) -> bool:
        """Take what the first camera sees in a frame; False if it has no part in it, or readings are still to come."""
        self._begin_after_gap(imu)
        self._readings.add(imu)
        if tracks.by_others_alone:
            return False
        tracks = unrolled(tracks.of_camera(0).finite(), self._calibration.cameras[0], imu.gyro_B[-1])
        self._waiting.append(tracks)
        self._sensors.add(tracks, self._calibration.cameras[0].model)
        self._cut()
        return bool(self._packets) and self._packets[-1][1] is tracks

    def _begin_after_gap(self, imu: ImuSegment) -> None:
        if imu.largest_gap_s > LARGEST_IMU_GAP_S:
            self.reset()
            _log.info("no readings for %.2f s: begun anew", imu.largest_gap_s)

    def _cut(self) -> None:
        """Give the frames that wait for readings theirs, as far as they reach; let go of what is too old."""
        while self._waiting and self._readings.cover(self._waiting[0].t_ns, self._waiting[0].t_ns):
            tracks = self._waiting.pop(0)
            begin_ns = self._packets[-1][1].t_ns if self._packets else tracks.t_ns
            if not (self._packets and linked(self._packets[-1][1], tracks)):
                self._linked_ns = tracks.t_ns
            self._packets.append((self._readings.between(begin_ns, tracks.t_ns), tracks))
        if self._packets:
            self._packets = self._last(_LONGEST_WINDOW_S)
            self._readings.forget_before(self._packets[0][1].t_ns - NS_PER_S // 2)

    def _static(self) -> InitialEstimate | None:
        packets = self._last(_STATIC_WINDOW_S)
        if _duration_s(packets) < 0.95 * _STATIC_WINDOW_S:
            return None
        return static.initialise(packets, self._calibration.imu)

    def _take_of_rig(self, imu: ImuSegment, tracks: FrameTracks) -> None:
        """Take a frame for a start by stereo; of those before only if readings and points lead on from them.

        Cameras may take turns, also such as see nothing in common: points lead on from the last of one camera's frames.
        """
        if len(self._given.cameras) == 1:
            return
        by_same = (seen for _, seen in reversed(self._of_rig) if np.isin(seen.camera, tracks.camera).any())
        before = next(by_same, None)
        gap = bool(self._of_rig) and imu.t_ns[0] != self._of_rig[-1][0].t_ns[-1]
        if gap or not (before is None or linked(before, tracks)):
            self._of_rig.clear()
        self._of_rig.append((imu, tracks))
        oldest_ns = tracks.t_ns - round(_LONGEST_STEREO_S * NS_PER_S)
        self._of_rig = [packet for packet in self._of_rig if packet[1].t_ns >= oldest_ns]

    def _stereo(self) -> InitialEstimate | None:
        packets = self._of_rig
        if not packets or _duration_s(packets) < _SHORTEST_STEREO_S or packets[-1][1].t_ns < self._next_stereo_ns:
            return None
        self._next_stereo_ns = packets[-1][1].t_ns + round((_SOON_S - 1e-3) * NS_PER_S)
        calibration = replace(self.calibration, imu=self._noise_in_motion())
        first, others = self._sigma(_WITHOUT_ITS_FRAMES), tuple(self._given_sigma for _ in calibration.cameras[1:])
        wrong = np.sqrt(np.diag(self._doubted(np.diag(first.stacked() ** 2))))
        doubted = replace(CameraSigma.of(wrong), readout_s=first.readout_s)
        known, doubted_cov = (
            rig.covariance(CalibrationEstimate(calibration, (sigma, *others))) for sigma in (first, doubted)
        )
        return stereo.initialise(packets, calibration, known, doubted_cov)

    def _dynamic(self) -> InitialEstimate | None:
        newest_ns, time_offset_ns = self._packets[-1][1].t_ns, self._calibration.cameras[0].time_offset_ns
        if newest_ns < self._next_attempt_ns or _duration_s(self._packets) < _SHORTEST_WINDOW_S:
            return None
        linked_s = _duration_s(self._linked(_LONGEST_WINDOW_S))
        why = f"points were followed through the last {linked_s:.1f} s alone, {_SHORTEST_WINDOW_S} s are needed"
        refuse_unless(linked_s >= _SHORTEST_WINDOW_S, why)
        self._wait_s = min(self._wait_s + _LATER_S, _LATEST_S)
        self._next_attempt_ns = newest_ns + round((self._wait_s - 1e-3) * NS_PER_S)
        if (found := self._sensors.judge(self._readings, self._calibration)) is not None:
            self._take_over(found)
        try:
            for _ in range(_MOST_CONTRADICTIONS):
                if self._calibration.cameras[0].time_offset_ns != time_offset_ns:
                    return None  # the next frames may have been cut already
                known = np.diag(self._sigma(_WITHOUT_ITS_FRAMES).stacked() ** 2)
                calibration = replace(self._calibration, imu=self._noise_in_motion())
                try:
                    packets, doubted = self._linked(self._window_s), self._doubted(known)
                    bias, was_found = self._sensors.bias_gyro_B, self._found is not None
                    estimate = dynamic.initialise(packets, calibration, known, doubted, bias, found=was_found)
                    return self._settled(estimate)
                except ContradictedError as other:
                    self._take_over(found_by(self._calibration, other.cameras, other.cov))
            raise RefusalError("images and readings contradict every calibration")
        except UnsureError:
            self._window_s = min(self._window_s * _LONGER, _LONGEST_WINDOW_S)
            raise
        except RefusalError:
            self._window_s = max(self._window_s / _LONGER, _USUAL_WINDOW_S)
            raise

    def _settled(self, estimate: InitialEstimate) -> InitialEstimate:
        """The ``estimate``, with what was found of the calibration as it has that."""
        if self._found is not None and estimate.cameras is not None:
            self._found = self._found.settled(estimate.cameras, estimate.cov_cameras)
            self._calibration = self._found.calibration
            _log.info("%d %s", estimate.states[-1].t_ns, self._found)
        return estimate

    def _sigma(self, factor: float = 1.0) -> CameraSigma:
        """How well the calibration is known, what was found of it ``factor`` times as unsure."""
        return self._given_sigma if self._found is None else self._found.sigma(self._given_sigma, factor)

    def _doubted(self, known: Float) -> Float:
        """``known`` (16, 16), with what the calibration may be wrong by where nothing bears it out."""
        out, camera = known.copy(), self._calibration.cameras[0]
        focal = np.zeros(CALIBRATION_SIZE)
        focal[INTRINSICS][:2] = camera.model.fx, camera.model.fy
        out[:3, :3] += np.eye(3) * _DOUBT_ROTATION**2
        out[OFFSET, OFFSET] += _DOUBT_OFFSET_S**2
        out[READOUT, READOUT] += _DOUBT_READOUT_S**2
        out += np.outer(focal, focal) * _DOUBT_FOCAL**2
        return out

    def _noise_in_motion(self) -> ImuNoise:
        """What the readings of the window are off by: white noise by how they jump, within what is given."""
        given, readings = self._calibration.imu, self._readings
        gyro, accel = (
            _JUMPS * roughness(readings.t_ns, values, order=1) for values in (readings.gyro_B, readings.accel_B)
        )
        return replace(
            given,
            gyro_density=min(gyro, _IN_MOTION * given.gyro_density),
            accel_density=min(accel, _IN_MOTION * given.accel_density),
        )

    def _take_over(self, found: Found) -> None:
        """Cut frames and readings anew, and see the points, as ``found`` has it."""
        _log.info("%d %s", self._packets[-1][1].t_ns, found)
        (before,), (camera,) = self._calibration.cameras, found.calibration.cameras
        self._found, self._calibration = found.after(self._found), found.calibration
        self._readings.move(camera.time_offset_ns - before.time_offset_ns)
        frames = [*(tracks for _, tracks in self._packets), *self._waiting]
        frames = [seen_anew(tracks, camera, self._readings.gyro_at(tracks.t_ns)) for tracks in frames]
        self._sensors.see_through(camera, self._readings)
        self._of_rig.clear()
        self._packets, self._waiting = [], [f for f in frames if f.t_ns >= self._readings.t_ns[0]]
        self._cut()

    def _last(self, seconds: float) -> list[Packet]:
        """The frames of the last ``seconds``."""
        oldest_ns = self._packets[-1][1].t_ns - seconds * 1e9
        return [packet for packet in self._packets if packet[1].t_ns >= oldest_ns]

    def _linked(self, seconds: float) -> list[Packet]:
        """Those of the last ``seconds`` since one showed nothing of what the one before did, as after a black one."""
        return [packet for packet in self._last(seconds) if packet[1].t_ns >= self._linked_ns]


def _duration_s(packets: list[Packet]) -> float:
    return (packets[-1][1].t_ns - packets[0][1].t_ns) * 1e-9
