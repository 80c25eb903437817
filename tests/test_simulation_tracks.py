"""Simulated tracks are exact projections of static landmarks, with births, deaths and noise as promised."""

import tracemalloc

import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import TrackOptions, TrackSimulator, simulated_sequence, simulated_stream
from vioframe.simulation.flights import flight
from vioframe.types import Calibration, FrameTracks, ImuNoise, ImuSample

RIG = packaged_calibration("euroc")
CALIBRATION = Calibration(RIG.cameras[:1], RIG.imu)
ON_BODY = RIG.cameras[0]
CAMERA = ON_BODY.model


def fly(name, options, seconds=10.0, seed=0, rig=CALIBRATION):
    """All landmarks there were in a flight, with the poses and tracks of its frames."""
    motion = flight(name, seconds, ON_BODY.R_BC).at(np.arange(0.0, seconds, 0.05))
    simulator = TrackSimulator(rig, options, np.random.default_rng(seed))
    poses = list(zip(motion.R_WB, motion.p_WB, strict=True))
    landmarks, frames = {}, []
    for k, pose in enumerate(poses):
        frames.append(simulator.observe(k, *pose))
        landmarks |= simulator.p_WF
    return landmarks, poses, frames


def project(landmarks, pose, ids, on_body=ON_BODY):
    """Pixels of landmarks through the conventions' own formula, p_W = R_WB (R_BC p_C + p_BC) + p_WB."""
    R_WB, p_WB = pose
    p_WF = np.array([landmarks[i] for i in ids.tolist()])
    p_BF = (p_WF - p_WB) @ R_WB
    return on_body.model.project((p_BF - on_body.p_BC) @ on_body.R_BC)


def test_without_noise_every_observation_is_the_projection_of_its_landmark():
    landmarks, poses, frames = fly("aggressive", TrackOptions(pixel_sigma=0.0))
    for pose, tracks in zip(poses, frames, strict=True):
        np.testing.assert_allclose(tracks.xy, project(landmarks, pose, tracks.ids), atol=1e-9)
        np.testing.assert_allclose(CAMERA.distort(tracks.xy_normalised), tracks.xy, atol=1e-6)
        assert CAMERA.contains(tracks.xy, border_px=5.0 - 1e-9).all()


@pytest.mark.parametrize("readout_s", [0.03, -0.02])
def test_a_rolling_shutter_sees_every_point_from_the_pose_at_the_time_of_its_row(readout_s):
    """Rays of two frames, from the poses at their own rows' times, meet in the landmark; from the stamps' they miss."""
    rolling = CALIBRATION.with_camera(0, readout_s=readout_s)
    sequence = simulated_sequence("aggressive", None, 0.0, duration_s=2.0, calibration=rolling)
    motion = flight("aggressive", 2.0, ON_BODY.R_BC)
    frames = [tracks for _, tracks in sequence.packets]
    gaps_m: dict[bool, list[float]] = {True: [], False: []}
    for k in range(10, 35):
        both, *at = np.intersect1d(frames[k].ids, frames[k + 3].ids, return_indices=True)
        assert len(both) > 30
        for in_time, gaps in gaps_m.items():
            rays, origins = [], []
            for frame, own in zip((k, k + 3), at, strict=True):
                seen = frames[frame].only(own)
                late_s = in_time * readout_s * ((seen.xy[:, 1] + 0.5) / 480 - 0.5)
                pose = motion.at(0.05 * frame + late_s)
                rays_B = np.column_stack([seen.xy_normalised, np.ones(len(both))]) @ ON_BODY.R_BC.T
                rays.append(np.einsum("nij,nj->ni", pose.R_WB, rays_B))
                origins.append(pose.R_WB @ ON_BODY.p_BC + pose.p_WB)
            normal = np.cross(*rays)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            gaps.append(float(np.abs(np.einsum("ni,ni->n", normal, origins[1] - origins[0])).max()))
    assert max(gaps_m[True]) < 1e-6
    assert max(gaps_m[False]) > 1e-2


def test_a_rolling_shutter_needs_to_know_where_the_body_is_meanwhile():
    simulator = TrackSimulator(CALIBRATION.with_camera(0, readout_s=0.03), TrackOptions(), np.random.default_rng(0))
    with pytest.raises(ConfigError, match="rolling shutter"):
        simulator.observe(0, np.eye(3), np.zeros(3))


def test_every_camera_of_a_rig_sees_the_landmarks_before_it_under_one_id():
    landmarks, poses, frames = fly("aggressive", TrackOptions(pixel_sigma=0.0, max_points=40), 3.0, rig=RIG)
    shared = 0
    for pose, tracks in zip(poses, frames, strict=True):
        visible = [tracks.ids[tracks.camera == c].tolist() for c in (0, 1)]
        assert all(len(ids) == len(set(ids)) >= 40 for ids in visible)
        shared += len(set(visible[0]) & set(visible[1]))
        for c, on_body in enumerate(RIG.cameras):
            seen = tracks.only(tracks.camera == c)
            np.testing.assert_allclose(seen.xy, project(landmarks, pose, seen.ids, on_body), atol=1e-9)
            np.testing.assert_allclose(on_body.model.distort(seen.xy_normalised), seen.xy, atol=1e-6)
    assert shared > 20 * len(frames)


def test_a_camera_with_a_clock_of_its_own_sees_another_instant():
    late = RIG.with_camera(1, time_offset_ns=RIG.cameras[0].time_offset_ns + 10_000_000)
    sequence = simulated_sequence("aggressive", None, 0.0, duration_s=2.0, calibration=late)
    motion = flight("aggressive", 2.0, ON_BODY.R_BC)
    for (_, tracks), k in list(zip(sequence.packets, range(41), strict=True))[1:-1]:
        both = np.intersect1d(tracks.ids[tracks.camera == 0], tracks.ids[tracks.camera == 1])
        assert len(both) > 10
        # Rays of the two cameras, each from the pose at its own instant, meet in the landmark.
        rays, origins = [], []
        for c, t_s in ((0, 0.05 * k), (1, 0.05 * k + 0.01)):
            at, on_body = motion.at(np.array([t_s])), RIG.cameras[c]
            seen = tracks.only((tracks.camera == c) & np.isin(tracks.ids, both))
            seen = seen.only(np.argsort(seen.ids))
            rays.append(np.column_stack([seen.xy_normalised, np.ones(len(both))]) @ (at.R_WB[0] @ on_body.R_BC).T)
            origins.append(at.R_WB[0] @ on_body.p_BC + at.p_WB[0])
        normal = np.cross(*rays)
        gap_m = np.abs(normal @ (origins[1] - origins[0])) / np.linalg.norm(normal, axis=1)
        assert gap_m.max() < 1e-7


def test_an_endless_stream_is_one_motion_and_takes_no_more_memory():
    readings, frames, living = [], [], []
    tracemalloc.start()
    for item in simulated_stream("figure_eight", None, TrackOptions(pixel_sigma=0.0), duration_s=120.0, piece_s=7.0):
        if isinstance(item, FrameTracks):
            frames.append((item.t_ns, len(item.ids)))
            if len(frames) in (200, 2400):
                living.append(tracemalloc.get_traced_memory()[0])
        else:
            readings.append((item.t_ns, *item.gyro_B, *item.accel_B))
    tracemalloc.stop()
    assert [t_ns for t_ns, _ in frames] == [1_000_000_000 + 50_000_000 * k for k in range(2401)]
    assert {count for _, count in frames} == {150}
    t_ns, exact = np.array([row[0] for row in readings]), np.array([row[1:] for row in readings])
    assert np.array_equal(t_ns, 1_000_000_000 + 5_000_000 * np.arange(24_001))
    motion = flight("figure_eight", 120.0, ON_BODY.R_BC).at((t_ns - t_ns[0]) * 1e-9)
    np.testing.assert_allclose(exact[:, :3], motion.omega_B, atol=1e-12)
    # What the test itself keeps is some 500 bytes a reading.
    assert living[1] - living[0] < 600 * 22_000


def test_biases_go_on_from_piece_to_piece():
    noise = ImuNoise(0.0, 0.0, 1e-3, 1e-2)

    def gyro(**pieces):
        stream = simulated_stream("standstill", noise, TrackOptions(max_points=1), duration_s=20.0, **pieces)
        return np.array([item.gyro_B for item in stream if isinstance(item, ImuSample)])

    for walk in (gyro(piece_s=2.0), gyro(piece_s=20.0)):
        steps = np.diff(walk, axis=0)
        assert len(steps) == 4000
        # No step is larger than those of a random walk, nor missing, at the seams or anywhere.
        assert np.abs(steps).max() < 5.0 * 1e-3 / np.sqrt(200.0)
        assert (np.abs(steps).max(axis=1) > 0.0).all()


def test_an_id_lives_once_and_for_as_long_as_its_landmark_is_in_view():
    landmarks, poses, frames = fly("aggressive", TrackOptions(pixel_sigma=0.0, max_points=60))
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
            p_CF = ON_BODY.R_BC.T @ (R_WB.T @ (landmarks[i] - p_WB) - ON_BODY.p_BC)
            if p_CF[2] > 0.3:
                # A ray outside the image's own corners: there the distortion model means nothing.
                outside = np.linalg.norm(p_CF[:2] / p_CF[2]) > 1.2
                assert outside or not CAMERA.contains(CAMERA.project(p_CF[None]), border_px=5.0)[0]
    assert ended > 100


def test_landmarks_are_born_at_the_depths_asked_for():
    landmarks, poses, frames = fly("figure_eight", TrackOptions(depth_m=(3.0, 5.0)), seconds=2.0)
    R_WB, p_WB = poses[0]
    p_WF = np.array([landmarks[i] for i in frames[0].ids.tolist()])
    depth = (((p_WF - p_WB) @ R_WB - ON_BODY.p_BC) @ ON_BODY.R_BC)[:, 2]
    assert 3.0 <= depth.min() < 3.2
    assert 4.8 < depth.max() <= 5.0


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_pixel_noise_is_white_and_of_the_size_asked_for(sigma):
    landmarks, poses, frames = fly("hover", TrackOptions(pixel_sigma=sigma), seconds=15.0)
    errors = [t.xy - project(landmarks, pose, t.ids) for pose, t in zip(poses, frames, strict=True)]
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
    options = TrackOptions(pixel_sigma=0.0, outlier_ratio=0.1)
    landmarks, poses, frames = fly("hover", options, seconds=5.0)
    off = np.concatenate(
        [np.linalg.norm(t.xy - project(landmarks, pose, t.ids), axis=1) for pose, t in zip(poses, frames, strict=True)]
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
    exact = flight("aggressive", 3.0, sequence.calibration.cameras[0].R_BC)
    for k, ((imu, tracks), state) in enumerate(zip(sequence.packets, sequence.true_states, strict=True)):
        assert imu.t_ns[-1] == tracks.t_ns == state.t_ns == sequence.ground_truth.t_ns[k]
        motion = exact.at(np.array([k / 30.0]))
        np.testing.assert_allclose(state.v_WB, motion.v_WB[0], atol=1e-12)
        # 30 Hz does not divide 200 Hz: readings at frames are interpolated, to within the curvature of the motion.
        np.testing.assert_allclose(imu.gyro_B[-1], motion.omega_B[0] + bias, atol=2e-3)
        assert np.array_equal(state.bias_gyro_B, bias)
