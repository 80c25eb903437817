"""Simulated tracks are exact projections of static landmarks, with births, deaths and noise as promised."""

import numpy as np
import pytest

from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import simulated_sequence
from vioframe.simulation.flights import flight
from vioframe.simulation.tracks import TrackOptions, TrackSimulator

CALIBRATION = packaged_calibration("euroc")
CAMERA = CALIBRATION.camera


def fly(name, options, seconds=10.0, seed=0):
    """The simulator after a flight, with the poses and tracks of its frames."""
    motion = flight(name, seconds, CALIBRATION.R_BC).at(np.arange(0.0, seconds, 0.05))
    simulator = TrackSimulator(CALIBRATION, options, np.random.default_rng(seed))
    poses = list(zip(motion.R_WB, motion.p_WB, strict=True))
    return simulator, poses, [simulator.observe(k, R, p) for k, (R, p) in enumerate(poses)]


def project(simulator, pose, ids):
    """Pixels of landmarks through the conventions' own formula, p_W = R_WB (R_BC p_C + p_BC) + p_WB."""
    R_WB, p_WB = pose
    p_WF = np.array([simulator.p_WF[i] for i in ids.tolist()])
    p_BF = (p_WF - p_WB) @ R_WB
    return CAMERA.project((p_BF - CALIBRATION.p_BC) @ CALIBRATION.R_BC)


def test_without_noise_every_observation_is_the_projection_of_its_landmark():
    simulator, poses, frames = fly("aggressive", TrackOptions(pixel_sigma=0.0))
    for pose, tracks in zip(poses, frames, strict=True):
        np.testing.assert_allclose(tracks.xy, project(simulator, pose, tracks.ids), atol=1e-9)
        np.testing.assert_allclose(CAMERA.distort(tracks.xy_normalised), tracks.xy, atol=1e-6)
        assert CAMERA.contains(tracks.xy, border_px=5.0 - 1e-9).all()


def test_an_id_lives_once_and_for_as_long_as_its_landmark_is_in_view():
    simulator, poses, frames = fly("aggressive", TrackOptions(pixel_sigma=0.0, max_points=60))
    assert [len(tracks.ids) for tracks in frames] == [60] * len(frames)
    seen: dict[int, list[int]] = {}
    for k, tracks in enumerate(frames):
        assert len(np.unique(tracks.ids)) == len(tracks.ids)
        for i in tracks.ids.tolist():
            seen.setdefault(i, []).append(k)
    assert len(seen) > 200  # the flight does turn over its landmarks
    ended = 0
    for i, at in seen.items():
        assert at == list(range(at[0], at[-1] + 1))
        if at[-1] + 1 < len(frames):
            ended += 1
            R_WB, p_WB = poses[at[-1] + 1]
            p_CF = CALIBRATION.R_BC.T @ (R_WB.T @ (simulator.p_WF[i] - p_WB) - CALIBRATION.p_BC)
            if p_CF[2] > 0.3:
                # A ray outside the image's own corners: there the distortion model means nothing.
                outside = np.linalg.norm(p_CF[:2] / p_CF[2]) > 1.2
                assert outside or not CAMERA.contains(CAMERA.project(p_CF[None]), border_px=5.0)[0]
    assert ended > 100


def test_landmarks_are_born_at_the_depths_asked_for():
    simulator, poses, frames = fly("figure_eight", TrackOptions(depth_m=(3.0, 5.0)), seconds=2.0)
    R_WB, p_WB = poses[0]
    p_WF = np.array([simulator.p_WF[i] for i in frames[0].ids.tolist()])
    depth = (((p_WF - p_WB) @ R_WB - CALIBRATION.p_BC) @ CALIBRATION.R_BC)[:, 2]
    assert 3.0 <= depth.min() < 3.2
    assert 4.8 < depth.max() <= 5.0


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_pixel_noise_is_white_and_of_the_size_asked_for(sigma):
    simulator, poses, frames = fly("hover", TrackOptions(pixel_sigma=sigma), seconds=15.0)
    errors = [t.xy - project(simulator, pose, t.ids) for pose, t in zip(poses, frames, strict=True)]
    e = np.concatenate(errors)
    bound = 5 / np.sqrt(len(e))
    np.testing.assert_allclose(e.mean(axis=0), 0.0, atol=bound * sigma)
    np.testing.assert_allclose(e.std(axis=0), sigma, rtol=bound)
    assert abs(np.corrcoef(e.T)[0, 1]) < bound
    # Independent from frame to frame: follow one landmark that stays.
    stays = [t.ids.tolist().index(0) for t in frames if 0 in t.ids]
    one = np.array([error[k] for error, k in zip(errors, stays, strict=False)])
    assert len(one) > 100
    assert abs(np.corrcoef(one[1:, 0], one[:-1, 0])[0, 1]) < 5 / np.sqrt(len(one))


def test_outliers_come_at_their_rate_and_size():
    options = TrackOptions(pixel_sigma=0.0, outlier_ratio=0.1, outlier_px=(5.0, 30.0))
    simulator, poses, frames = fly("hover", options, seconds=5.0)
    off = np.concatenate(
        [np.linalg.norm(t.xy - project(simulator, pose, t.ids), axis=1) for pose, t in zip(poses, frames, strict=True)]
    )
    wrong = off > 1e-6
    assert wrong.mean() == pytest.approx(0.1, abs=5 * np.sqrt(0.1 * 0.9 / len(off)))
    assert 5.0 - 1e-9 <= off[wrong].min() < 6.0
    assert 29.0 < off[wrong].max() <= 30.0 + 1e-9


def test_a_sequence_is_decided_by_its_seed():
    def numbers(seed):
        sequence = simulated_sequence("figure_eight", seed=seed, duration_s=2.0, outlier_ratio=0.05)
        return [np.concatenate([i.gyro_B.ravel(), t.xy.ravel(), t.ids]) for i, t in sequence.packets]

    first, again, other = numbers(4), numbers(4), numbers(5)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_segments_and_states_belong_to_the_frames():
    bias = np.array([0.01, -0.02, 0.03])
    sequence = simulated_sequence("aggressive", None, 0.0, duration_s=3.0, frame_rate_hz=30.0, bias_gyro_B=bias)
    assert len(sequence.packets) == len(sequence.true_states) == len(sequence.ground_truth) == 91
    assert len(sequence.packets[0][0].t_ns) == 1
    exact = flight("aggressive", 3.0, sequence.calibration.R_BC)
    for k, ((imu, tracks), state) in enumerate(zip(sequence.packets, sequence.true_states, strict=True)):
        assert imu.t_ns[-1] == tracks.t_ns == state.t_ns == sequence.ground_truth.t_ns[k]
        motion = exact.at(np.array([k / 30.0]))
        np.testing.assert_allclose(state.v_WB, motion.v_WB[0], atol=1e-12)
        # 30 Hz does not divide 200 Hz: readings at frames are interpolated, to within the curvature of the motion.
        np.testing.assert_allclose(imu.gyro_B[-1], motion.omega_B[0] + bias, atol=2e-3)
        assert np.array_equal(state.bias_gyro_B, bias)
