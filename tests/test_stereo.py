"""Two cameras before a wall: what both see has one id, and lies where geometry puts it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_frontend import CAMERA, PERIOD_NS, SKY, texture

from vioframe.frontend import Frontend, FrontendOptions
from vioframe.frontend.flow import projected
from vioframe.frontend.stereo import overlapping
from vioframe.geometry import so3, two_view
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.types import CameraOnBody, FrameSet, FrameTracks, ImuSegment
from vioframe_shi_tomasi import ShiTomasi

WALL_M = 2.5
LEFT = CameraOnBody("cam0", CAMERA, so3.exp([0.3, -1.2, 0.8]), np.array([0.1, -0.2, 0.05]))
SMALLER = replace(CAMERA, fx=250.0, fy=251.0, cx=130.0, cy=100.0, resolution=(260, 200))


def beside(turn=(0.01, -0.03, 0.02), model=CAMERA) -> CameraOnBody:
    """A camera to the right of the left one, turned by so much, rad."""
    return CameraOnBody("cam1", model, LEFT.R_BC @ so3.exp(turn), LEFT.p_BC + LEFT.R_BC @ [0.15, 0.01, -0.02])


def rig(right: CameraOnBody):
    return replace(packaged_calibration("euroc", cameras=["cam0"]), cameras=(LEFT, right))


RIG = rig(beside())


def shown(camera: CameraOnBody, moved_m: float = 0.0):
    """The wall, which stands before the left camera and moves along its x axis."""
    R_C2C1, p_C2C1 = LEFT.seen_from(camera)
    wall_to_ray = np.array([[1 / 300.0, 0.0, -699.5 / 300.0], [0.0, 1 / 300.0, -499.5 / 300.0], [0.0, 0.0, 1.0]])
    wall_to_ray = np.array([[1.0, 0.0, moved_m / WALL_M], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ wall_to_ray
    plane = R_C2C1 + np.outer(p_C2C1, [0.0, 0.0, 1.0]) / WALL_M
    return cv2.warpPerspective(SKY, camera.model.K @ plane @ wall_to_ray, camera.model.resolution)


# As many points in the second camera as in the first.
OPTIONS = FrontendOptions(max_points=80, overlap_share=1.0)


def play(calibration, sets, options=OPTIONS) -> list[FrameTracks]:
    frontend = Frontend(ShiTomasi(), calibration, options, Incidents())
    steps = []
    for k, images in enumerate(sets, start=1):
        t_ns = k * PERIOD_NS + np.linspace(-PERIOD_NS, 0, 11).astype(np.int64)
        imu = ImuSegment(t_ns, np.zeros((11, 3)), np.zeros((11, 3)))
        steps.append(frontend.track(imu, FrameSet(k * PERIOD_NS, images), calibration))
    return steps


def pairs(tracks: FrameTracks):
    """Ids that both cameras see, and where each does on the z = 1 plane."""
    left, right = tracks.of_camera(0), tracks.of_camera(1)
    ids, i, j = np.intersect1d(left.ids, right.ids, assume_unique=True, return_indices=True)
    return ids, left.xy_normalised[i], right.xy_normalised[j]


def flown(count: int, calibration=RIG, step_m: float = 0.02):
    return [tuple(shown(camera, step_m * k) for camera in calibration.cameras) for k in range(count)]


@pytest.mark.parametrize(("model", "median_px"), [(CAMERA, 0.12), (SMALLER, 0.5)], ids=["alike", "smaller"])
def test_what_both_cameras_see_has_one_id_and_lies_on_the_wall(model, median_px):
    calibration = rig(beside(model=model))
    steps = play(calibration, flown(6, calibration))
    R_C2C1, p_C2C1 = calibration.cameras[0].seen_from(calibration.cameras[1])

    def on_wall(xy_normalised):
        return WALL_M * two_view.rays(xy_normalised) @ R_C2C1.T + p_C2C1

    for tracks in steps:
        ids, left, right = pairs(tracks)
        _, in_view = projected(model, on_wall(tracks.of_camera(0).xy_normalised))
        assert len(ids) > 0.6 * in_view.sum() > 20
        expected, _ = projected(model, on_wall(left))
        off_px = np.linalg.norm(model.distort(right) - expected, axis=1)
        assert np.median(off_px) < median_px
        assert np.percentile(off_px, 95) < 4.0 * median_px
        np.testing.assert_allclose(
            np.median(two_view.inverse_depths(left, right, R_C2C1, p_C2C1)), 1.0 / WALL_M, rtol=0.02
        )
        for camera in (0, 1):
            seen = tracks.of_camera(camera).ids
            assert len(np.unique(seen)) == len(seen)
    assert len(np.intersect1d(pairs(steps[0])[0], pairs(steps[-1])[0])) > 20


@pytest.mark.parametrize("off_px", [0, 8])
def test_what_contradicts_the_calibration_is_not_paired(off_px):
    """The right image is lower than it could be: texture alone would match."""
    images = [(left, np.roll(right, off_px, axis=0)) for left, right in flown(3)]
    counts = [len(pairs(tracks)[0]) for tracks in play(RIG, images)]
    assert min(counts) > 20 if off_px == 0 else max(counts) < 5


def test_a_pair_that_begins_to_contradict_the_calibration_is_parted():
    images = flown(6)
    images[3:] = [(left, np.roll(right, 8, axis=0)) for left, right in images[3:]]
    steps = play(RIG, images)
    before, after = pairs(steps[2])[0], pairs(steps[3])[0]
    assert len(before) > 20
    assert len(np.intersect1d(before, after)) < 5
    assert np.isin(before, steps[3].of_camera(0).ids).mean() > 0.8


def test_cameras_that_see_nothing_in_common_follow_points_of_their_own():
    back = beside((0.0, np.pi, 0.0))
    calibration = rig(back)
    assert overlapping(calibration) == ()
    images = (shown(LEFT), texture((240, 320), 7))
    tracks = play(calibration, [images, images])[-1]
    assert not len(pairs(tracks)[0])
    assert min(len(tracks.of_camera(c).ids) for c in (0, 1)) > 30


def test_a_camera_that_goes_black_takes_up_the_same_landmarks_again():
    images = flown(9)
    images[3:6] = [(left, np.zeros_like(right)) for left, right in images[3:6]]
    steps = play(RIG, images)
    black, again = steps[4], steps[6]
    assert not len(black.of_camera(1).ids)
    assert len(black.of_camera(0).ids) > 60
    assert len(np.intersect1d(pairs(again)[0], pairs(steps[2])[0])) > 15


def test_what_a_camera_has_let_go_of_by_itself_is_not_given_back_to_it():
    """Something is before the right lens in one frame; what it hid is there again in the next, and the left saw it."""
    images = flown(12)
    images[3] = (images[3][0], images[3][1].copy())
    images[3][1][40:200] = 90
    steps = play(RIG, images)
    right = [tracks.of_camera(1).ids for tracks in steps]
    hidden = np.setdiff1d(right[2], right[3])
    hidden = hidden[np.isin(hidden, steps[-1].of_camera(0).ids)]
    assert len(hidden) > 10
    assert not any(np.isin(hidden, later).any() for later in right[3:])


def test_a_camera_that_brings_no_image_holds_up_no_other():
    images = flown(6)
    images[2] = (None, images[2][1])
    images[4] = (images[4][0], None)
    steps = play(RIG, images)
    assert set(steps[2].camera) == {1}
    assert set(steps[4].camera) == {0}
    common = np.intersect1d(steps[1].of_camera(0).ids, steps[3].of_camera(0).ids)
    assert len(common) > 0.8 * len(steps[1].of_camera(0).ids)
    assert len(pairs(steps[5])[0]) > 20


def test_what_one_camera_saw_alone_is_taken_over_by_the_other():
    """The left camera is black at first: its points then are those that the right one has found."""
    images = flown(3)
    images[0] = (np.zeros_like(images[0][0]), images[0][1])
    first, second, _ = play(RIG, images)
    assert len(np.intersect1d(first.of_camera(1).ids, second.of_camera(0).ids)) > 20


SHARED = FrontendOptions(max_points=80, overlap_share=0.25)


def test_the_second_camera_follows_a_share_of_what_both_see():
    tracks = play(RIG, flown(6), options=SHARED)[-1]
    one, other = (len(tracks.of_camera(c).ids) for c in (0, 1))
    assert 70 <= one <= 80
    (_, pair) = overlapping(RIG)
    assert (pair.first, pair.second) == (0, 1)
    assert 0.7 < pair.overlap < 1.0
    share = 1.0 - 0.75 * pair.overlap
    assert 0.85 * 80 * share < other < 80 * share + 1.0
    assert len(pairs(tracks)[0]) > 0.7 * other


def test_of_what_comes_into_view_the_second_camera_follows_some_as_well():
    """The first ones lie where they have gone by then: on the right."""
    ids, _, right = pairs(play(RIG, flown(12, step_m=0.15), options=SHARED)[-1])
    on_the_left = CAMERA.distort(right)[:, 0] < CAMERA.resolution[0] / 2
    assert len(ids) > 20
    assert on_the_left.sum() >= 3


@pytest.mark.parametrize("why", ["black", "silent"])
def test_the_second_camera_follows_as_many_as_it_can_once_the_first_shows_nothing(why):
    images = flown(9)
    images[3:] = [(np.zeros_like(left) if why == "black" else None, right) for left, right in images[3:]]
    steps = play(RIG, images, options=SHARED)
    assert len(steps[2].of_camera(1).ids) < 40
    assert len(steps[-1].of_camera(1).ids) > 70


def test_a_camera_that_sees_little_of_what_another_does_follows_points_of_its_own():
    aside = rig(beside((0.0, 0.75, 0.0)))
    (_, pair) = overlapping(aside)
    assert 0.1 < pair.overlap < 0.35
    images = (shown(LEFT), texture((240, 320), 7))
    tracks = play(aside, [images, images], options=SHARED)[-1]
    assert len(tracks.of_camera(1).ids) > 0.6 * 80


def turned(camera: CameraOnBody, R_B1B2) -> CameraOnBody:
    """The camera, in B1, of a body that has turned to B2."""
    return replace(camera, R_BC=R_B1B2 @ camera.R_BC, p_BC=R_B1B2 @ camera.p_BC)


def one_after_the_other(rate_B, apart_s: float = 0.02, off_px: int = 0):
    """The left image, then the right one, of a body that turns at ``rate_B`` rad/s; and the cameras as they were."""
    frontend = Frontend(ShiTomasi(), RIG, OPTIONS, Incidents())
    cameras = LEFT, turned(RIG.cameras[1], so3.exp(np.array(rate_B) * apart_s))
    right = np.roll(shown(cameras[1]), off_px, axis=0)
    steps, before_ns = [], 0
    for t_ns, images in ((PERIOD_NS, (shown(LEFT), None)), (PERIOD_NS + round(apart_s * 1e9), (None, right))):
        stamps = np.linspace(before_ns, t_ns, 11).astype(np.int64)
        imu = ImuSegment(stamps, np.tile(rate_B, (11, 1)), np.zeros((11, 3)))
        steps.append(frontend.track(imu, FrameSet(t_ns, images), RIG))
        before_ns = t_ns
    return steps, cameras


@pytest.mark.parametrize("rate_B", [(0.0, 0.0, 0.0), (0.0, 2.5, 0.0), (1.5, 0.0, -1.5)])
def test_cameras_that_take_turns_share_their_points(rate_B):
    (left, right), (first, second) = one_after_the_other(rate_B)
    assert set(left.camera) == {0}
    assert set(right.camera) == {1}
    _, i, j = np.intersect1d(left.ids, right.ids, assume_unique=True, return_indices=True)
    assert len(i) > 20
    R_C2C1, p_C2C1 = first.seen_from(second)
    on_wall = WALL_M * two_view.rays(left.xy_normalised[i]) @ R_C2C1.T + p_C2C1
    expected, _ = projected(second.model, on_wall)
    assert np.median(np.linalg.norm(second.model.distort(right.xy_normalised[j]) - expected, axis=1)) < 0.2


@pytest.mark.parametrize("why", [{"off_px": 25}, {"apart_s": 0.08}], ids=["contradicts", "too long ago"])
def test_cameras_that_take_turns_share_nothing_that_cannot_be(why):
    (left, right), _ = one_after_the_other((0.0, 0.0, 0.0), **why)
    assert len(np.intersect1d(left.ids, right.ids)) < 5
