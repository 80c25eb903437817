"""No start is believed because a calibration is: motion must bear it out, or another that fits is taken over."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from vioframe.diagnosis.inertial import times_as_rough
from vioframe.diagnosis.recording import ImuSamples
from vioframe.errors import DivergedError
from vioframe.estimation.factors.reprojection import INTRINSICS, OFFSET, Calibrated
from vioframe.estimation.inertial.noise import noise_over, roughness
from vioframe.estimation.initialization import InitialEstimate, Initializer, dynamic
from vioframe.estimation.initialization.found import found_by
from vioframe.estimation.initialization.sensors import SensorCheck
from vioframe.estimation.initialization.window import ContradictedError, RefusalError, UnsureError
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.geometry import so3
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.io.synchronise import Synchroniser, synchronise
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.types import Calibration, FrameSet, FrameTracks, ImuSegment, Measurement, Status
from vioframe_msckf.backend import Msckf

EUROC = packaged_calibration("euroc", cameras=["cam0"])
BIASES = {"bias_gyro_B": np.array([-0.002, 0.02, 0.08]), "bias_accel_B": np.array([-0.02, 0.13, 0.07])}
AXIS = np.array([0.6, 0.64, 0.48])


def hovering(seed: int = 0, pixel_sigma: float = 0.5) -> TrackSequence:
    """Slow and hardly turning: what is wrong hides behind the noise of a second and a half."""
    return simulated_sequence("hover", pixel_sigma=pixel_sigma, seed=seed, duration_s=6.0, **BIASES)


def begun(sequence: TrackSequence, told: Calibration) -> tuple[InitialEstimate, Initializer]:
    initializer = Initializer(told)
    for imu, tracks in sequence.packets:
        seen = tracks.undistorted(initializer.calibration.cameras[0].model)
        if (estimate := initializer.add(imu, seen)) is not None:
            return estimate, initializer
    raise AssertionError(initializer.refusal)


def scale_of(estimate: InitialEstimate, sequence: TrackSequence) -> float:
    truth = sequence.ground_truth
    true = np.array([truth.p_WB[np.searchsorted(truth.t_ns, state.t_ns)] for state in estimate.states])
    path = np.array([state.p_WB for state in estimate.states])
    return float(np.linalg.norm(path - path.mean(axis=0)) / np.linalg.norm(true - true.mean(axis=0)))


@pytest.mark.parametrize("percent", [-10.0, 10.0])
def test_a_focal_length_that_turns_do_not_tell(percent: float):
    s = hovering()
    true = s.calibration.cameras[0].model
    estimate, initializer = begun(s, s.calibration.with_camera(0, model=true.zoomed(1.0 + percent / 100.0)))
    found = initializer.found
    assert found is not None
    assert found.focal_sigma is not None
    assert abs(found.calibration.cameras[0].model.fx / true.fx - 1.0) < 0.04
    assert abs(scale_of(estimate, s) - 1.0) < 0.1


def test_a_rotation_that_turns_do_not_tell():
    s = hovering(3)
    true = s.calibration.cameras[0].R_BC
    _, initializer = begun(s, s.calibration.with_camera(0, R_BC=true @ so3.exp(np.deg2rad(8.0) * AXIS)))
    assert initializer.found is not None
    left = so3.log(initializer.calibration.cameras[0].R_BC.T @ true)
    assert np.rad2deg(np.linalg.norm(left)) < 4.0


@pytest.mark.parametrize(("seed", "pixel_sigma"), [(0, 0.5), (1, 0.5), (2, 0.5), (0, 0.05), (2, 0.05)])
def test_a_calibration_that_is_right_stays(seed: int, pixel_sigma: float):
    """However accurate points are: of a readout, say, that turns do not tell, nothing is believed."""
    s = hovering(seed, pixel_sigma)
    estimate, initializer = begun(s, s.calibration)
    assert initializer.found is None
    assert abs(scale_of(estimate, s) - 1.0) < 0.1


def test_a_readout_that_nobody_told():
    rolling = EUROC.with_camera(0, readout_s=0.03)
    s = simulated_sequence("aggressive", pixel_sigma=0.5, seed=1, duration_s=6.0, calibration=rolling, **BIASES)
    _, initializer = begun(s, s.calibration.with_camera(0, readout_s=0.0))
    found = initializer.found
    assert found is not None
    assert found.readout_sigma_s is not None
    assert found.calibration.cameras[0].readout_s == pytest.approx(0.03, abs=0.006)
    assert "readout" in str(found)
    assert initializer.camera_sigma.readout_s == found.readout_sigma_s


def test_a_flight_from_rest_with_a_camera_mounted_quite_differently_begins_again():
    s = simulated_sequence("inspection", pixel_sigma=0.5, duration_s=9.0, **BIASES)
    true = s.calibration.cameras[0].R_BC
    wrong = s.calibration.with_camera(0, R_BC=true @ so3.exp(np.deg2rad(90.0) * AXIS))
    life, events, statuses = LifeCycle(Msckf(), wrong), [], []
    for imu, tracks in s.packets:
        estimate = life.process(imu, tracks)
        events += estimate.events
        statuses.append(estimate.status)
    assert "initialised (static)" in events
    (lost,) = [event for event in events if event.startswith("lost")]
    assert "mounted differently" in lost
    left = so3.log(life.calibration.cameras[0].R_BC.T @ true)
    assert np.rad2deg(np.linalg.norm(left)) < 3.0
    assert "initialised (dynamic)" in events
    assert statuses[-1] is Status.TRACKING


def test_motion_ends_the_doubt_of_a_flight_from_rest():
    s = simulated_sequence("inspection", pixel_sigma=0.5, duration_s=9.0, **BIASES)
    life, doubted = LifeCycle(Msckf(), s.calibration), []
    for imu, tracks in s.packets:
        assert life.process(imu, tracks).status is not Status.LOST
        doubted.append(life._initializer.in_doubt)
    assert any(doubted)
    assert not doubted[-1]


@pytest.mark.parametrize("offset_ms", [-50, 50])
def test_frames_that_were_cut_before_another_time_offset_was_found(offset_ms: int, monkeypatch):
    """No start is made of them, and they are as if they had been cut by it."""
    s, asked = hovering(), [0]

    def contradicted_once(packets, *_, **__):
        asked.append(packets[-1][1].t_ns)
        if len(asked) > 1:
            raise RefusalError("enough")
        camera = Calibrated(*TestFoundBy.other(offset_s=1e-3 * offset_ms))
        raise ContradictedError(camera, TestFoundBy.COV)

    monkeypatch.setattr(dynamic, "initialise", contradicted_once)
    monkeypatch.setattr(SensorCheck, "judge", lambda *_: None)  # to which the offset given looked right
    offset_ns, tracks = 1_000_000 * offset_ms, {tracks.t_ns: tracks for _, tracks in s.packets}
    at_once = Initializer(s.calibration.with_camera(0, time_offset_ns=offset_ns))
    for measured in synchronise(readings_and_frames(s), Incidents(), time_offset_ns=offset_ns):
        at_once.add(measured[0], tracks[measured[1].t_ns])
    asked.clear()

    synchroniser, initializer, since = Synchroniser(Incidents(), wait_ms=0.0), Initializer(s.calibration), []
    for measurement in readings_and_frames(s):
        for imu, frame in synchroniser.add(measurement):
            cut_by_ns = 0 if len(since) < 4 else offset_ns
            assert initializer.add(imu, tracks[frame.t_ns], cut_by_ns) is None
            if asked:
                since.append((frame.t_ns, len(asked)))
            if len(since) == 4:
                synchroniser.retime(offset_ns)
    assert initializer.calibration.cameras[0].time_offset_ns == offset_ns
    assert [attempts for _, attempts in since[:4]] == [1, 1, 1, 1]
    assert since[-1][1] > 2
    # From the first frame on that had been cut before.
    waited = [packet for packet in initializer._packets if packet[1].t_ns > since[0][0]]
    due = {packet.t_ns: imu for imu, packet in at_once._packets}
    assert len(waited) > 20
    for imu, packet in waited:
        np.testing.assert_array_equal(imu.t_ns, due[packet.t_ns].t_ns)
        np.testing.assert_allclose(imu.gyro_B, due[packet.t_ns].gyro_B, rtol=0.0, atol=1e-12)


def readings_and_frames(sequence: TrackSequence) -> Iterator[Measurement]:
    for measured in sequence.measurements():
        yield FrameSet(measured.t_ns, ()) if isinstance(measured, FrameTracks) else measured


class TestFoundBy:
    COV = np.diag(np.repeat([0.01, 0.01, 0.004, 1e-9, 4.0, 0.01], [3, 3, 1, 1, 4, 4]) ** 2)

    @staticmethod
    def other(turn: float = 0.0, offset_s: float = 0.0, zoom: float = 1.0) -> Calibrated:
        camera = EUROC.cameras[0]
        turned = replace(camera, R_BC=camera.R_BC @ so3.exp(turn * AXIS), model=camera.model.zoomed(zoom))
        return Calibrated.of(turned)._replace(offset_s=np.array([offset_s]))

    def test_only_what_is_clearly_off(self):
        found = found_by(EUROC, self.other(turn=0.001, offset_s=0.002, zoom=1.05), self.COV)
        (camera,), (given,) = found.calibration.cameras, EUROC.cameras
        assert camera.model.fx == pytest.approx(1.05 * given.model.fx)
        assert (found.offset_sigma_s, found.rotation_sigma) == (None, None)
        assert camera.time_offset_ns == given.time_offset_ns
        np.testing.assert_array_equal(camera.R_BC, given.R_BC)
        # The mean of both focal lengths is known better than each.
        assert found.focal_sigma == pytest.approx(4.0 / given.model.focal_px / np.sqrt(2.0), rel=0.01)

    def test_all_that_is(self):
        found = found_by(EUROC, self.other(turn=0.1, offset_s=-0.03, zoom=0.9), self.COV)
        (camera,) = found.calibration.cameras
        assert camera.time_offset_ns == -30_000_000
        np.testing.assert_allclose(so3.log(EUROC.cameras[0].R_BC.T @ camera.R_BC), 0.1 * AXIS, atol=1e-9)
        assert camera.model.fx == pytest.approx(0.9 * EUROC.cameras[0].model.fx)

    def test_the_farthest_where_nothing_is_clear(self):
        found = found_by(EUROC, self.other(turn=0.001, offset_s=0.009), self.COV)
        assert found.calibration.cameras[0].time_offset_ns == 9_000_000
        assert found.rotation_sigma is None

    def test_not_what_is_hardly_known(self):
        cov = self.COV.copy()
        cov[OFFSET, OFFSET] = 0.03**2
        with pytest.raises(UnsureError, match="offset"):
            found_by(EUROC, self.other(offset_s=0.1), cov)
        cov[INTRINSICS, INTRINSICS] *= 100.0
        with pytest.raises(UnsureError, match="focal"):
            found_by(EUROC, self.other(zoom=1.5), cov)


class TestNoise:
    @staticmethod
    def readings(times: float, gap_s: float = 0.0) -> ImuSegment:
        """Ten seconds at rest, with white noise so many times what the calibration has."""
        rng, noise = np.random.default_rng(0), EUROC.imu
        t_ns = np.arange(2001) * 5_000_000
        gyro, accel = (
            times * density * np.sqrt(200.0) * rng.normal(size=(2001, 3))
            for density in (noise.gyro_density, noise.accel_density)
        )
        return ImuSegment(t_ns, gyro, accel, max(gap_s, 0.005))

    def test_roughness_is_the_density_of_white_noise(self):
        imu, density = self.readings(1.0), EUROC.imu.gyro_density
        for order in (1, 2):
            assert roughness(imu.t_ns, imu.gyro_B, order) == pytest.approx(density, rel=0.1)
            assert roughness(imu.t_ns[:order], imu.gyro_B[:order], order) == 0.0
        # A steady turn, or a steady change of it, is none; nor is what a body does of its own accord.
        seconds = imu.t_ns[:, None] * 1e-9
        for motion in (2.0 + 3.0 * seconds, 1.5 * np.sin(2 * np.pi * 1.5 * seconds)):
            assert roughness(imu.t_ns, imu.gyro_B + motion) == pytest.approx(density, rel=0.1)
        # A difference from one reading to the next is jump enough for an order of 1.
        fast = imu.gyro_B + 30.0 * seconds
        assert roughness(imu.t_ns, fast, order=1) > 3.0 * roughness(imu.t_ns, fast)

    @pytest.mark.parametrize(("times", "expected"), [(0.1, 1.0), (1.0, 1.0), (2.0, 3.0), (10.0, 4.0)])
    def test_between_rest_and_flight(self, times: float, expected: float):
        """Noise of the sensor's own is what its calibration says; vibration counts twice what is rougher than that.

        The accelerometer's bias walks faster by as much, and the gyroscope's does not.
        """
        rest, flight = EUROC.imu, EUROC.imu.times(4.0, 4.0, 2.5)
        noise = noise_over(self.readings(times), rest, flight)
        assert noise.gyro_density == pytest.approx(expected * rest.gyro_density, rel=0.15)
        assert noise.accel_density == pytest.approx(expected * rest.accel_density, rel=0.15)
        assert noise.accel_walk == pytest.approx(min(expected, 2.5) * rest.accel_walk, rel=0.15)
        assert noise.gyro_walk == rest.gyro_walk

    @pytest.mark.parametrize("flight", ["figure_eight", "aggressive"])
    def test_without_vibration_there_is_none(self, flight: str):
        """The readings of a frame are few, and rough by chance, too: in the mean they are taken for what they are."""
        sequence = simulated_sequence(flight, duration_s=20.0)
        own = sequence.calibration.imu
        found = [noise_over(imu, own, own.times(4.0, 4.0, 4.0)) for imu, _ in sequence.packets]
        assert np.mean([n.gyro_density for n in found]) == pytest.approx(own.gyro_density, rel=0.1)
        assert np.mean([n.accel_density for n in found]) == pytest.approx(own.accel_density, rel=0.1)
        assert np.mean([n.accel_walk for n in found]) == pytest.approx(own.accel_walk, rel=0.1)

    @pytest.mark.parametrize("times", [1.0, 10.0])
    def test_how_rough_a_recording_is_is_told(self, times: float):
        imu = self.readings(times)
        told = times_as_rough(ImuSamples(imu.t_ns, imu.gyro_B, imu.accel_B), EUROC.imu)
        assert told == pytest.approx((times, times), rel=0.1)

    def test_what_is_asked_for_is_the_most(self):
        noise = noise_over(self.readings(10.0), EUROC.imu, EUROC.imu.times(0.5, 0.5))
        assert noise.gyro_density == 0.5 * EUROC.imu.gyro_density

    def test_a_sensor_that_is_given_no_noise_has_none(self):
        ideal = EUROC.imu.times(0.0, 0.0)
        assert noise_over(self.readings(10.0), ideal, ideal.times(4.0, 4.0, 2.5)) == ideal

    def test_gaps(self):
        """A turn of 0.5 rad/s and an acceleration of 2 m/s^2, unseen for 0.1 s, are as white noise turns and moves."""
        rest, flight = EUROC.imu, EUROC.imu.times(4.0, 4.0)
        without, short, across = (noise_over(self.readings(1.0, gap_s), rest, flight) for gap_s in (0.0, 0.02, 0.1))
        assert short == without
        assert (across.gyro_density - without.gyro_density) * 0.1**0.5 == pytest.approx(0.5 * 0.1)
        assert (across.accel_density - without.accel_density) * 0.1**0.5 == pytest.approx(2.0 * 0.1)
        assert across.accel_walk == without.accel_walk
        # From five readings on that are missing in a row.
        assert noise_over(self.readings(1.0, 0.025), rest, flight).gyro_density > 0.05
        with pytest.raises(DivergedError, match="no inertial readings for"):
            noise_over(self.readings(1.0, 0.6), rest, flight)
