"""Recognising places: its steps one by one, whole flights in rendered worlds, and the files of a run."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from time import sleep

import numpy as np
import pytest
from click.testing import CliRunner
from loop_helpers import CALIBRATION, CAMERA, depths, fly, hall, path_along, tiled_corridor
from rendered_flight import rendered_flight

from vioframe.cli import main
from vioframe.evaluation import evaluate
from vioframe.geometry import so3
from vioframe.geometry.meshes import ray_scene
from vioframe.geometry.so3 import rotation_z
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.runs.evaluated import Evaluated
from vioframe.runs.folder import RunFolder
from vioframe.runs.recorder import Recorder
from vioframe.simulation.config import RIGS
from vioframe.simulation.renderer import Renderer
from vioframe.testing import check_loop_closer
from vioframe.types import CalibrationEstimate, CameraSigma, Estimate, FrameSet, FrameTracks, NavState, Status, Step
from vioframe_pose_graph import verification, vioframe_loop_closers
from vioframe_pose_graph.closer import PoseGraph
from vioframe_pose_graph.consistency import agreed, measured
from vioframe_pose_graph.corners import located, seen_again
from vioframe_pose_graph.keyframes import KeyframeSelector
from vioframe_pose_graph.matching import DescriptorIndex, distance, match
from vioframe_pose_graph.patches import Patches, Picture, laid_over
from vioframe_pose_graph.place import Place, View, corner_finder, image_angle_deg
from vioframe_pose_graph.recognition import Recogniser
from vioframe_pose_graph.verification import (
    Correspondences,
    Relation,
    _refined,
    aligned,
    hypotheses,
    ransac,
    residuals,
    supported,
)

FOCAL_PX = CAMERA.model.focal_px


def random_descriptors(rng, count):
    return rng.integers(0, 2**64, (count, 4), dtype=np.uint64)


def flipped(descriptors, bits, rng):
    """The same with ``bits`` of their 256 bits changed."""
    out = np.unpackbits(descriptors.view(np.uint8).reshape(-1, 32), axis=1)
    for row in out:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(out, axis=1).view(np.uint64)


def test_the_distance_of_descriptors_is_the_number_of_bits():
    rng = np.random.default_rng(0)
    a, b = random_descriptors(rng, 50), random_descriptors(rng, 50)
    expected = np.unpackbits((a ^ b).view(np.uint8).reshape(50, 32), axis=1).sum(axis=1)
    assert [distance(x, y) for x, y in zip(a, b, strict=True)] == expected.tolist()


def test_a_match_must_be_near_and_unrivalled():
    rng = np.random.default_rng(1)
    target = random_descriptors(rng, 4)
    target[3] = flipped(target[2:3], 4, rng)[0]
    xy = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 50.0], [200.0, 200.0]])
    query = np.concatenate([flipped(target[:1], 20, rng), flipped(target[1:2], 90, rng), flipped(target[2:3], 40, rng)])
    # The second is too far from its original; the third has two originals in different places.
    assert match(query, target, xy, 64, 0.85, 10.0).tolist() == [0, -1, -1]
    xy[3] = xy[2] + 3.0  # one corner, described twice
    assert match(query, target, xy, 64, 0.85, 10.0)[2] in (2, 3)


def test_the_index_finds_the_keyframe_that_holds_the_descriptors():
    rng = np.random.default_rng(2)
    keyframes = [random_descriptors(rng, 300) for _ in range(30)]
    index = DescriptorIndex()
    rows = [index.add(descriptors, number) for number, descriptors in enumerate(keyframes)]
    for added, descriptors in zip(rows, keyframes, strict=True):
        np.testing.assert_array_equal(index.descriptors(added), descriptors)
    # Twelve of a hundred bits wrong, as between two views of a place.
    scores = index.similarity(flipped(keyframes[7], 30, rng), before=30)
    assert scores.argmax() == 7
    assert scores[7] > 20.0 * np.sort(scores)[-2]
    assert not index.similarity(flipped(keyframes[7], 30, rng), before=7).any()


def test_a_descriptor_that_is_everywhere_counts_little():
    rng = np.random.default_rng(3)
    common = random_descriptors(rng, 10)
    index = DescriptorIndex()
    for number in range(40):
        index.add(np.concatenate([common, random_descriptors(rng, 20)]), number)
    own = random_descriptors(rng, 10)
    index.add(own, 40)
    assert index.similarity(own, 41)[40] > 10.0 * index.similarity(common, 41).max()


def test_two_points_and_gravity_give_the_pose():
    rng = np.random.default_rng(4)
    yaw, t = rng.uniform(-np.pi, np.pi, 200), rng.normal(0.0, 5.0, (200, 3))
    p = rng.normal(0.0, 5.0, (2, 200, 3))
    centre = rng.normal(0.0, 2.0, (200, 3))
    ways = np.einsum("hij,phj->phi", rotation_z(yaw), p) + t - centre
    ray_1, ray_2 = ways[0] / ways[0, :, 1:2], ways[1] / np.abs(ways[1]).max(axis=1, keepdims=True)
    yaws, ts = hypotheses(*p, ray_1, ray_2, centre)
    turned = np.abs(np.angle(np.exp(1j * (yaws - yaw[:, None]))))
    errors = np.abs(ts - t[:, None]).max(axis=2) + turned
    rays_ahead = ways[0, :, 1] > 0.0
    assert ((np.where(np.isnan(errors), np.inf, errors).min(axis=1) < 1e-6) == rays_ahead).all()


def two_views(rng, count=80, outliers=0.0, tilt=(0.0, 0.0), depth_m=(4.0, 10.0)):
    """Points of both sides, seen by two cameras whose worlds are turned and shifted to one another.

    World A is out of the vertical by ``tilt`` rad about x and y, turned by that about its camera, which both know: what
    is said of where the cameras are is by the vertical of B.
    """
    yaw, t = 0.3, np.array([1.0, -2.0, 0.5])
    look = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # level, along x
    R_A, p_A = look, np.array([0.0, 0.0, 0.0])
    R_B = rotation_z(-yaw) @ rotation_z(0.1) @ look
    p_B = rotation_z(yaw).T @ (np.array([0.5, 0.3, 0.1]) - t)
    in_A = np.column_stack([rng.uniform(*depth_m, count), rng.uniform(-3.0, 3.0, (count, 2))])
    in_B = (in_A - t) @ rotation_z(yaw)
    half = count // 2
    seen_A = (in_A[:half] - p_A) @ R_A
    leaning = so3.exp(np.append(tilt, 0.0))
    R_A, in_A = leaning @ R_A, p_A + (in_A - p_A) @ leaning.T
    points = np.concatenate([in_B[:half], in_A[half:]])
    seen_B = (in_B[half:] - p_B) @ R_B
    seen = np.concatenate([seen_A, seen_B])
    xy = seen[:, :2] / seen[:, 2:]
    wrong = rng.random(count) < outliers
    xy[wrong] = rng.uniform(-0.6, 0.6, (wrong.sum(), 2))
    side = np.repeat([0, 1], [half, count - half])
    pairs = np.column_stack([np.arange(count), np.arange(count)])
    R_WC, p_WC = np.stack([R_A, R_B]), np.stack([p_A, p_B])
    depth_sigma = rng.uniform(0.02, 0.1, count)
    return Correspondences(points, depth_sigma, xy, side, R_WC, p_WC, pairs), yaw, t, wrong


def test_ransac_finds_the_pose_among_wrong_matches():
    rng = np.random.default_rng(5)
    seen, yaw, t, wrong = two_views(rng, outliers=0.6)
    picks = np.array([[i, j] for i in range(0, 80, 3) for j in range(1, 80, 5) if i != j and (i < 40) == (j < 40)])
    support, found_yaw, found_t = ransac(seen, picks, 0.005)
    assert support >= np.sum(~wrong)
    np.testing.assert_allclose([found_yaw, *found_t], [yaw, *t], atol=1e-6)


def test_points_support_where_they_are_seen_ahead():
    rng = np.random.default_rng(12)
    tried, count, tolerance = 20, 60, 0.5
    points, xy = rng.normal(scale=3.0, size=(count, 3)), rng.normal(scale=0.5, size=(count, 2))
    side = rng.integers(0, 2, count)
    R_WC = np.array([so3.exp(rng.normal(size=3)) for _ in range(2)])
    p_WC, t = rng.normal(size=(2, 3)), rng.normal(size=(tried, 3))
    yaw = np.concatenate([rng.uniform(-3.0, 3.0, tried - 1), [np.nan]])
    R = rotation_z(yaw)[:, None]
    forth = (R @ points[..., None])[..., 0] + t[:, None]
    back = (np.swapaxes(R, 2, 3) @ (points - t[:, None])[..., None])[..., 0]
    there = np.where(side[:, None] == 0, forth, back)
    p_C = np.einsum("mji,hmj->hmi", R_WC[side], there - p_WC[side])
    near = np.linalg.norm(p_C[..., :2] / p_C[..., 2:] - xy, axis=2) < tolerance
    expected = np.sum(near & (p_C[..., 2] > 0.0), axis=1)
    assert 0 == expected[-1] < expected[:-1].max()
    assert (near & (p_C[..., 2] < 0.0)).any()
    np.testing.assert_array_equal(supported(yaw, t, points, xy, side, R_WC, p_WC, tolerance), expected)


def test_the_jacobian_of_the_relation_is_its_derivative():
    rng = np.random.default_rng(6)
    seen, yaw, t, _ = two_views(rng, count=20)
    p_B = np.array([1.0, 2.0, 0.5])
    R_AB = so3.exp(np.array([0.02, -0.01, 0.0])) @ rotation_z(yaw)
    p_AB = rotation_z(yaw) @ p_B + t + 0.05
    _, J, along = residuals(seen, p_B, p_AB, R_AB)
    for k, d in enumerate(1e-6 * np.eye(6)):
        plus = residuals(seen, p_B, p_AB + d[:3], so3.exp(d[3:]) @ R_AB)[0]
        minus = residuals(seen, p_B, p_AB - d[:3], so3.exp(-d[3:]) @ R_AB)[0]
        np.testing.assert_allclose(J[:, :, k], (plus - minus) / 2e-6, atol=1e-7)
    source, sigma = seen.p_WC[1 - seen.side], seen.depth_sigma[:, None]
    far, near = (replace(seen, points=source + (1.0 + d * sigma) * (seen.points - source)) for d in (1e-6, -1e-6))
    apart = residuals(far, p_B, p_AB, R_AB)[0] - residuals(near, p_B, p_AB, R_AB)[0]
    np.testing.assert_allclose(along, apart / 2e-6, atol=1e-7)


def test_points_of_uncertain_depth_tell_what_they_can():
    """Depths are off by 2 to 10 %, pixels by a half, at 460 px: the relation is as far off as its covariance says."""
    rng, tolerance = np.random.default_rng(7), 3.0 / 460.0
    squares, off = [], []
    for _ in range(200):
        seen, yaw, t, _ = two_views(rng, count=80)
        source = seen.p_WC[1 - seen.side]
        depth = 1.0 + seen.depth_sigma[:, None] * rng.standard_normal((len(seen.points), 1))
        xy = seen.xy + 0.5 / 460.0 * rng.standard_normal(seen.xy.shape)
        noisy = replace(seen, points=source + depth * (seen.points - source), xy=xy)
        (p_A, p_B), R_AB = seen.p_WC, rotation_z(np.array(yaw))
        p_AB = R_AB @ p_B + t
        found = _refined(noisy, R_AB, p_AB, p_A, p_B, tolerance, 25)
        error = np.append(found.z - (p_AB - p_A), found.yaw - yaw)
        squares.append(error @ np.linalg.solve(found.cov, error) / 4.0)
        off.append(np.linalg.norm(error[:3]))
    assert 0.5 < np.mean(squares) < 1.5
    assert np.median(off) < 0.01


def fitted(seen, yaw, t):
    """How far the fit puts the later camera from where it is, m."""
    (p_A, p_B), R_AB = seen.p_WC, rotation_z(np.array(yaw))
    p_AB = R_AB @ p_B + t
    found = _refined(seen, R_AB, p_AB, p_A, p_B, 3.0 / 460.0, 25)
    return np.linalg.norm(found.z - (p_AB - p_A))


def noisy(seen, rng, sigma_px=0.2):
    return replace(seen, xy=seen.xy + sigma_px / 460.0 * rng.standard_normal(seen.xy.shape))


def errors_of_fits(monkeypatch, draw, **constants):
    """The median error of fits to what ``draw`` draws, as they are and with other ``constants``, of the same draws."""
    both = []
    for changed in ({}, constants):
        rng = np.random.default_rng(11)
        with monkeypatch.context() as patched:
            for name, value in changed.items():
                patched.setattr(verification, name, value)
            both.append(np.median([fitted(*draw(rng)) for _ in range(60)]))
    return both


def test_matches_beside_their_point_hardly_move_the_fit(monkeypatch):
    """A fifth of the points is seen 2.5 px beside where it is, all on one side: least squares follow them."""

    def draw(rng):
        seen, yaw, t, _ = two_views(rng)
        beside = rng.random(len(seen.xy)) < 0.2
        return noisy(replace(seen, xy=seen.xy + np.outer(beside, [2.5 / 460.0, 0.0])), rng), yaw, t

    robust, least_squares = errors_of_fits(monkeypatch, draw, _HEAVY=1e9)
    assert robust < 0.6 * least_squares


def test_attitudes_that_agree_tell_what_points_in_one_plane_do_not(monkeypatch):
    """Of a wall ahead, whether the camera is beside it or turned is told by a few of its points only."""

    def draw(rng):
        seen, yaw, t, _ = two_views(rng, depth_m=(6.0, 6.2))
        return noisy(seen, rng), yaw, t

    held, free = errors_of_fits(monkeypatch, draw, _TILT_SIGMA=np.radians(0.5))
    assert held < 0.7 * free


def test_attitudes_that_disagree_yield_to_the_points(monkeypatch):
    """By half a degree, far more than a good odometry's do; held to what those keep, the fit would be pulled along."""

    def draw(rng):
        seen, yaw, t, _ = two_views(rng, tilt=np.radians([0.5, -0.4]))
        return noisy(seen, rng), yaw, t

    yielding, held = errors_of_fits(monkeypatch, draw, _weight=lambda squared: np.ones(np.shape(squared)))
    assert yielding < 0.5 * held


def test_where_attitudes_disagree_the_later_one_knows_what_is_upright():
    seen, yaw, t, _ = two_views(np.random.default_rng(13), tilt=np.radians([0.3, -0.4]))
    assert fitted(seen, yaw, t) < 0.002


@dataclass(frozen=True)
class Shot:
    """A picture of the hall: as it is kept, where the camera was, and how far away its points are by exact geometry."""

    place: Place
    view: View
    picture: Picture


@pytest.fixture(scope="module")
def shots():
    """Of one wall: from a place, from 40 cm beside, and from 1.5 m ahead, rolled by 60 degrees; and another way."""
    p_WB = np.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.0], [1.5, 0.2, 0.1], [0.0, 0.0, 0.0]])
    truth = path_along(p_WB, np.array([0.0, 0.0, 0.05, np.pi]))
    world, model = hall(truth, 3), CAMERA.model
    renderer, scene, orb = Renderer(model, world), ray_scene(world.mesh.corners), corner_finder(600)
    taken = []
    for k, (t_ns, R_WB, p) in enumerate(zip(truth.t_ns.tolist(), truth.R_WB, truth.p_WB, strict=True)):
        R_WC, p_WC = R_WB @ CAMERA.R_BC, p + R_WB @ CAMERA.p_BC
        if k == 2:
            R_WC = R_WC @ so3.exp(np.array([0.0, 0.0, np.radians(60.0)]))
        image = np.clip(255.0 * renderer.render(R_WC, p_WC), 0.0, 255.0).astype(np.uint8)
        corners = orb.detect(image)
        for corner in corners:
            corner.angle = image_angle_deg(R_WC)
        corners, descriptors = orb.compute(image, corners)
        xy = model.undistort(np.array([corner.pt for corner in corners])).astype(np.float32)
        depth, rays = depths(scene, R_WC, p_WC, xy.astype(np.float64))
        place = Place(t_ns, 0, R_WB, p, p, R_WC, p_WC, np.full((4, 4), np.nan))
        p_WF = (p_WC + depth[:, None] * rays).astype(np.float32)
        view = View(xy, p_WF, np.full(len(xy), 0.004, np.float32), descriptors.view(np.uint64))
        taken.append(Shot(place, view, Picture.of(image, model)))
    return taken


def patches_of(shot):
    return Patches.of(shot.picture, shot.view.xy_normalised.astype(np.float64))


def exact_px(first, second):
    """Where exact geometry has the points of the first in the second, (K, 2) px."""
    return CAMERA.model.project((first.view.p_WF - second.place.p_WC) @ second.place.R_WC)


def off_px(first, second, xy):
    return np.linalg.norm(CAMERA.model.distort(xy) - exact_px(first, second), axis=1)


@pytest.mark.parametrize("which", [1, 2], ids=["beside", "rolled"])
def test_a_corner_is_found_again_to_parts_of_a_pixel(shots, which):
    """Corners alone are found again to a pixel, as they are found to one."""
    first, second = shots[0], shots[which]
    apart = 10.0 / FOCAL_PX
    matches = match(first.view.descriptors, second.view.descriptors, second.view.xy_normalised, 48, 0.85, apart)
    R_CC = second.place.R_WC.T @ first.place.R_WC
    xy = seen_again(first.view, patches_of(first), second.view, second.picture, R_CC, apart)
    found = np.isfinite(xy[:, 0])
    assert not found[matches < 0].any()
    assert found[matches >= 0].mean() > 0.75
    assert found.sum() > 40
    alone = np.where(found[:, None], second.view.xy_normalised[matches], np.nan)
    by_patch, by_corner = (np.nanmedian(off_px(first, second, seen)) for seen in (xy, alone))
    assert by_patch < 0.2
    assert by_patch < 0.25 * by_corner


def laid(first, second, guess_off_px):
    """Where the patches of the first are found in the second, laid there as geometry says."""
    first_C, place = (first.view.p_WF - first.place.p_WC) @ first.place.R_WC, second.place
    R_TS, t_TS = place.R_WC.T @ first.place.R_WC, place.R_WC.T @ (first.place.p_WC - place.p_WC)
    xy = first.view.xy_normalised.astype(np.float64)
    guess, warp = laid_over(CAMERA.model, xy, 1.0 / first_C[:, 2], R_TS, t_TS)
    return guess, warp, patches_of(first).found_in(second.picture, guess + guess_off_px, warp)


def test_a_patch_is_found_where_it_is_turned_and_larger(shots):
    first, _, ahead, _ = shots
    guess, warp, xy = laid(first, ahead, guess_off_px=1.0)
    inside = CAMERA.model.contains(guess, 20.0)
    assert inside.sum() > 100
    np.testing.assert_allclose(guess[inside], exact_px(first, ahead)[inside], atol=1e-2)
    assert np.median(np.sqrt(np.linalg.det(warp[inside]))) > 1.1
    assert np.isfinite(xy[inside, 0]).mean() > 0.5
    assert np.nanmedian(off_px(first, ahead, xy)) < 0.25
    upright = patches_of(first).found_in(ahead.picture, guess, np.tile(np.eye(2), (len(xy), 1, 1)))
    assert np.nanmedian(off_px(first, ahead, upright)) > 4.0 * np.nanmedian(off_px(first, ahead, xy))


def related(first, second, moved_m, turned_deg):
    """The relation of two pictures of one world, off by as much."""
    z = second.place.p_WB_seen - first.place.p_WB_seen + moved_m
    return Relation(z, np.radians(turned_deg), np.eye(4), 30)


@pytest.mark.parametrize("which", [1, 2], ids=["beside", "ahead"])
def test_patches_put_a_relation_right(shots, which):
    first, second = shots[0], shots[which]
    roughly = related(first, second, np.array([0.01, -0.015, 0.01]), 0.1)
    known = first.place, first.view
    found = aligned(roughly, known, patches_of(first), second.place, second.picture, 25)
    assert found.inliers > 60
    np.testing.assert_allclose(found.z, related(first, second, 0.0, 0.0).z, atol=0.004)
    assert abs(found.yaw) < np.radians(0.03)


def test_a_relation_stays_where_nothing_looks_as_it_did(shots):
    """Of the patches of one wall on another some are found by chance, and agree by chance: by far enough for a loop."""
    first, *_, elsewhere = shots
    patches, roughly = patches_of(first), related(first, first, 0.0, 0.0)
    assert aligned(roughly, (first.place, first.view), patches, first.place, first.picture, 25) is not roughly
    assert aligned(roughly, (first.place, first.view), patches, first.place, elsewhere.picture, 25) is roughly


def test_a_relation_stays_where_too_few_patches_tell_better(shots):
    first, second, *_ = shots
    few = np.arange(len(first.view.p_WF))[:, None] < 24
    view = replace(first.view, p_WF=np.where(few, first.view.p_WF, np.float32(np.nan)))
    roughly = related(first, second, 0.02, 0.2)
    patches = patches_of(first).select(slice(24))
    assert aligned(roughly, (first.place, view), patches, second.place, second.picture, 25) is roughly


def test_descriptors_turn_with_the_camera():
    """Rolled by 40 degrees, the direction that stands for down is turned by that in the image."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    assert image_angle_deg(level) == pytest.approx(90.0)
    rolled = level @ so3.exp(np.array([0.0, 0.0, np.radians(40.0)]))
    assert image_angle_deg(rolled) == pytest.approx(50.0)


def a_row_of_keyframes(rng, sigma):
    """Three keyframes, a third of a metre apart, that see the same points: where these are, how the first two saw them,
    and what the last one saw.

    Of the last keyframe the first 60 points are known; the odometry has strayed by 6 cm between any two of them.
    """
    look = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # level, along x
    p_WF = np.column_stack([rng.uniform(3.0, 8.0, 300), rng.uniform(-1.5, 1.5, (300, 2))])
    before = []
    for k in (2, 1, 0):
        p_WC = np.array([0.05 * k, 0.35 * k, 0.02 * k])
        ahead = (p_WF - p_WC) @ look
        xy = ahead[:, :2] / ahead[:, 2:] + sigma * rng.standard_normal((300, 2))
        said = p_WC + k * np.array([0.02, 0.06, -0.02])
        place = Place(k, 0, np.eye(3), said, said, look, said, np.full((4, 4), np.nan))
        before.append((place, xy))
    place, xy = before.pop()
    known = np.where(np.arange(300)[:, None] < 60, p_WF, np.nan).astype(np.float32)
    view = View(xy.astype(np.float32), known, np.full(300, 0.02, np.float32), random_descriptors(rng, 300))
    return p_WF, before, (place, view)


def test_corners_are_where_the_keyframes_before_saw_them_whatever_the_odometry_says_of_the_way():
    sigma = 1.0 / 460.0
    p_WF, before, (place, view) = a_row_of_keyframes(np.random.default_rng(8), sigma)
    corners = located(place, view, before, sigma)
    np.testing.assert_array_equal(corners.p_WF[:60], view.p_WF[:60])
    found = np.isfinite(corners.p_WF[:, 0])
    assert found.mean() > 0.9
    far, true = (np.linalg.norm(p - place.p_WC, axis=1)[60:] for p in (corners.p_WF, p_WF))
    off = (far / true - 1.0)[found[60:]]
    # The way that the odometry has strayed by is a sixth of what it has gone.
    assert abs(off.mean()) < 0.02
    # Where the keyframes before were is not known exactly, either.
    assert 0.8 < np.sqrt(np.mean((off / corners.depth_sigma[60:][found[60:]]) ** 2)) < 1.6


def test_what_is_no_corner_gets_no_position():
    """In the other keyframes every third is seen elsewhere: hardly one of them is taken for the same point."""
    rng, sigma = np.random.default_rng(9), 1.0 / 460.0
    _, before, (place, view) = a_row_of_keyframes(rng, sigma)
    wrong = np.arange(60, 300, 3)
    moved = []
    for at, seen in before:
        xy = seen.copy()
        xy[wrong] = rng.uniform(-0.4, 0.4, (len(wrong), 2))
        moved.append((at, xy))
    corners = located(place, view, moved, sigma)
    found = np.isfinite(corners.p_WF[:, 0])
    right = np.setdiff1d(np.arange(60, 300), wrong)
    assert found[right].mean() > 0.9
    assert found[wrong].mean() < 0.05


def test_too_few_known_points_place_no_corner():
    _, before, (place, view) = a_row_of_keyframes(np.random.default_rng(10), 1.0 / 460.0)
    few = np.where(np.arange(300)[:, None] < 9, view.p_WF, np.float32(np.nan))
    dark = before[0][0], np.full((300, 2), np.nan)
    corners = located(place, replace(view, p_WF=few), [*before, dark], 1.0 / 460.0)
    assert np.isfinite(corners.p_WF[:, 0]).sum() == 9


def closure_of(flown, steps=None):
    closer = PoseGraph(CALIBRATION)
    for step in flown.steps if steps is None else steps:
        closer.add(step)
    return closer.finish()


def corrections_of(flown):
    """What is known with each step of where the map has it."""
    closer = PoseGraph(CALIBRATION)
    return [closer.add(step) for step in flown.steps]


def is_identity(correction):
    return np.array_equal(correction.R_MW, np.eye(3)) and not correction.p_MW.any()


def there_and_back(frames=22):
    """12 m ahead and back again, the camera ahead all the time: every place is seen twice."""
    x = np.concatenate([np.linspace(0.0, 12.0, frames), np.linspace(11.8, 0.2, frames)])
    p = np.column_stack([x, 0.5 * np.sin(x / 3.0), 0.2 * np.sin(x)])
    return path_along(p, np.zeros(len(p)), interval_s=0.8)


@pytest.fixture(scope="module")
def revisit():
    truth = there_and_back()
    return fly(truth, hall(truth, 1), np.random.default_rng(1))


def test_places_seen_again_take_out_the_drift(revisit):
    closure = closure_of(revisit)
    accepted = [loop for loop in closure.loops if loop.accepted]
    assert len(accepted) >= 5
    truth = revisit.truth
    i, j = np.searchsorted(truth.t_ns, [(loop.earlier_t_ns, loop.later_t_ns) for loop in accepted]).T
    way = np.linalg.norm(truth.p_WB[j] - truth.p_WB[i], axis=1)
    off = np.abs(np.linalg.norm([loop.p_L for loop in accepted], axis=1) - way)
    turned = np.degrees(np.abs([loop.yaw for loop in accepted]))  # the path is flown without turning
    assert np.mean((off < 0.1) & (turned < 0.5)) > 0.9
    assert np.mean((off < 0.05) & (turned < 0.2)) > 0.8
    assert np.median(off) < 0.01
    assert off.max() < 0.1
    assert np.median(turned) < 0.06
    assert turned.max() < 0.8
    before, after = evaluate(revisit.odometry, truth), evaluate(closure.trajectory, truth)
    assert after.ate_m.rmse < 0.3 * before.ate_m.rmse
    ends = [
        np.linalg.norm((t.p_WB[-1] - t.p_WB[0]) - (truth.p_WB[-1] - truth.p_WB[0]))
        for t in (revisit.odometry, closure.trajectory)
    ]
    assert ends[1] < 0.3 * ends[0]


def test_the_result_does_not_depend_on_time(revisit):
    first, second = closure_of(revisit), closure_of(revisit)
    assert np.array_equal(first.trajectory.p_WB, second.trajectory.p_WB)
    assert [loop.earlier_t_ns for loop in first.loops] == [loop.earlier_t_ns for loop in second.loops]


def test_the_drift_is_taken_out_while_flying(revisit):
    """Once places are seen again, at the earliest 10 s after, the newest pose is put by them.

    It is put no better than the odometry had that place when it saw it first: the farther back, the better.
    """
    corrections, truth, odometry = corrections_of(revisit), revisit.truth, revisit.odometry
    corrected = np.array([not is_identity(correction) for correction in corrections])
    first = int(np.argmax(corrected))
    assert corrected[first:].all()
    assert 10.0 < (truth.t_ns[first] - truth.t_ns[0]) * 1e-9 < 30.0
    turned = []
    for k in range(first, len(truth)):
        R_MW, p_MW = corrections[k].R_MW, corrections[k].p_MW
        R_MB, p_MB = R_MW @ odometry.R_WB[k], R_MW @ odometry.p_WB[k] + p_MW
        assert np.linalg.norm(p_MB - truth.p_WB[k]) < 0.75 * np.linalg.norm(odometry.p_WB[k] - truth.p_WB[k])
        turned.append(np.degrees(np.linalg.norm(so3.log(truth.R_WB[k].T @ R_MB))))
    # A loop from 4 m away that is wrong by as much as a degree and a half is believed until others contradict it.
    assert np.mean(turned) < 0.5
    assert max(turned) < 1.2
    assert np.linalg.norm(odometry.p_WB[-1] - truth.p_WB[-1]) > 0.6
    assert np.linalg.norm(p_MB - truth.p_WB[-1]) < 0.15


def test_the_correction_does_not_depend_on_time(revisit, monkeypatch):
    at_once, add = corrections_of(revisit), Recogniser.add

    def slowly(self, keyframe):
        sleep(0.05)
        add(self, keyframe)

    monkeypatch.setattr(Recogniser, "add", slowly)
    for first, second in zip(at_once, corrections_of(revisit), strict=True):
        assert np.array_equal(first.R_MW, second.R_MW)
        assert np.array_equal(first.p_MW, second.p_MW)


def test_what_is_settled_while_flying_is_what_asking_again_would_say(revisit):
    closer = PoseGraph(CALIBRATION)
    for step in revisit.steps:
        closer.add(step)
    closer.finish()
    t_ns, _, odometry = closer._keyframes()
    sightings = closer._recogniser.sightings[: closer._weighed]
    assert len(closer._sound) > 5
    assert closer._sound.tolist() == np.flatnonzero(agreed(measured(sightings), odometry, t_ns)).tolist()


def test_a_reset_in_between_is_joined_by_loops(revisit):
    """After a reset the odometry goes on 3 m beside where it was, turned by 20 degrees."""
    R, shift = rotation_z(np.radians(20.0)), np.array([3.0, -1.0, 0.4])
    steps, half = [], len(revisit.steps) // 2
    for k, step in enumerate(revisit.steps):
        estimate = step.estimate
        if half <= k < half + 2:
            estimate = Estimate(Status.LOST)
        elif k >= half + 2:
            state = replace(estimate.state, R_WB=R @ estimate.state.R_WB, p_WB=R @ estimate.state.p_WB + shift)
            estimate = replace(estimate, state=state, p_WF=estimate.p_WF @ R.T + shift)
        steps.append(replace(step, estimate=estimate))
    closure = closure_of(revisit, steps)
    assert len(closure.trajectory) == len(steps) - 2
    assert sum(loop.accepted for loop in closure.loops) >= 5
    assert evaluate(closure.trajectory, revisit.truth).ate_m.max < 0.5


def test_one_texture_all_over_closes_no_loop():
    """In a corridor tiled with one picture every place looks like many others."""
    truth = there_and_back()
    flown = fly(truth, tiled_corridor(12.0, 2.0, 3), np.random.default_rng(2))
    closure = closure_of(flown)
    assert closure.loops, "no place resembled another: the world is too easy"
    assert not any(loop.accepted for loop in closure.loops)
    np.testing.assert_allclose(closure.trajectory.p_WB, flown.odometry.p_WB, atol=1e-9)
    assert all(is_identity(correction) for correction in corrections_of(flown))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_no_place_is_recognised_on_a_way_without_return(seed):
    x = np.linspace(0.0, 30.0, 30)
    truth = path_along(np.column_stack([x, 3.0 * np.sin(x / 6.0 + seed), 0.4 * np.sin(x / 3.0)]), interval_s=1.0)
    closure = closure_of(fly(truth, hall(truth, seed), np.random.default_rng(seed)))
    assert not any(loop.accepted for loop in closure.loops)


def test_it_conforms():
    check_loop_closer(vioframe_loop_closers()["pose_graph"])


def test_a_run_writes_its_loops(tmp_path):
    flight = rendered_flight()
    bag, truth, out = flight.write(tmp_path / "f.bag"), flight.write_ground_truth(tmp_path / "t.tum"), tmp_path / "run"
    arguments = ["run", str(bag), "--ground-truth", str(truth), "--out", str(out), "--loop-closure", "pose_graph"]
    result = CliRunner().invoke(main, [*arguments, "-o", "min_gap_s=5"])
    assert result.exit_code == 0, result.output
    assert "with loop closure: ATE" in result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["loop_closer"] == "pose_graph"
    assert {"keyframes", "loops", "rejected", "seconds_beside"} == set(summary["loop_closure"])
    assert summary["mean_ms"]["loop_closure"] > 0.0
    assert [s["poses"] for s in summary["segments"]] == [len((out / "trajectory.tum").read_text().splitlines()) - 1]
    stamps = [
        [line.split()[0] for line in (out / name).read_text().splitlines() if line[0] != "#"]
        for name in ("trajectory.tum", "trajectory_loop.tum")
    ]
    assert stamps[0] == stamps[1]
    with (out / "loops.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(int(row["accepted"]) for row in rows) == summary["loop_closure"]["loops"]
    with (out / "loop_corrections.csv").open() as file:
        corrections = list(csv.DictReader(file))
    assert corrections[0] == {**dict.fromkeys(corrections[0], "0"), "t_ns": str(summary["first_frame_t_ns"])}
    assert len(corrections) > 1, "no loop was believed while flying"
    assert "min_gap_s: 5.0" in (out / "config.yaml").read_text()
    again = CliRunner().invoke(main, ["evaluate", str(out), "--format", "csv"])
    assert "run with loop closure" in again.output
    assert (out / "evaluation_loop.json").is_file()


def test_a_run_without_a_loop_closer_writes_none(tmp_path):
    bag, out = rendered_flight().write(tmp_path / "f.bag"), tmp_path / "run"
    result = CliRunner().invoke(main, ["run", str(bag), "--out", str(out), "--duration", "3", "--quiet"])
    assert result.exit_code == 0, result.output
    assert not (out / "loops.csv").exists()
    assert "loop_closure: null" in (out / "config.yaml").read_text()


def test_an_unknown_loop_closer_is_one_line(tmp_path):
    bag = rendered_flight().write(tmp_path / "f.bag")
    result = CliRunner().invoke(main, ["run", str(bag), "--loop-closure", "pose_grph", "--out", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert "no loop closer is called 'pose_grph' (did you mean 'pose_graph'?)" in result.output


def test_lines_break_at_resets_and_gaps():
    """A reset that took less than a second, and a gap without one, each begin a line of their own."""
    t_ns = np.array([0, 1, 2, 3, 4, 30, 31]) * 100_000_000
    run = Evaluated("run", None, None, None, None, segment_starts_ns=(300_000_000,))
    assert run.breaks(t_ns).tolist() == [3, 5]
    assert replace(run, segment_starts_ns=(0, 9_000_000_000)).breaks(t_ns).tolist() == [5]


def test_the_summary_lists_the_segments(revisit, tmp_path):
    statuses = [Status.INITIALISING, Status.TRACKING, Status.TRACKING, Status.LOST, Status.TRACKING]
    with Recorder(tmp_path, {}, Incidents(), 0.0) as recorder:
        for status, step in zip(statuses, revisit.steps, strict=False):
            estimate = step.estimate if status is Status.TRACKING else Estimate(status)
            recorder.add(replace(step, estimate=estimate))
    t_ns = [step.frames.t_ns for step in revisit.steps]
    assert recorder.summary["segments"] == [
        {"first_t_ns": t_ns[1], "last_t_ns": t_ns[2], "poses": 2},
        {"first_t_ns": t_ns[4], "last_t_ns": t_ns[4], "poses": 1},
    ]
    assert RunFolder.open(tmp_path).segment_starts_ns() == (t_ns[4],)


def test_a_keyframe_is_placed_by_what_was_learned_of_the_offset_since_the_start():
    """What the start found, the readings count with already."""
    found_ns, learned_ns, period_ns = 50_000_000, 10_000_000, 50_000_000
    selector, keyframes = KeyframeSelector(CALIBRATION, 30.0), []
    image, v_WB, zero = np.zeros((10, 10), np.uint8), np.array([1.0, 0.0, 0.0]), np.zeros(3)
    for k, offset_ns in enumerate((found_ns, found_ns + learned_ns)):
        t_ns = k * period_ns
        state = NavState(t_ns, np.eye(3), v_WB * t_ns * 1e-9, v_WB, zero, zero)
        learned = CalibrationEstimate(
            CALIBRATION.with_camera(0, time_offset_ns=offset_ns), (CameraSigma(zero, zero, 0.001, np.zeros(8)),)
        )
        ids, xy = np.array([k]), np.zeros((1, 2))
        estimate = Estimate(Status.TRACKING, state, is_keyframe=True, calibration=learned)
        tracks = FrameTracks(t_ns, ids, np.zeros_like(ids), xy, xy)
        keyframes += selector.add(Step(FrameSet(t_ns, (image,)), tracks, estimate, {}))
    keyframes += selector.flush()
    moved_m = [keyframe.p_WC[0] - keyframe.state.p_WB[0] - CAMERA.p_BC[0] for keyframe in keyframes]
    np.testing.assert_allclose(moved_m, [0.0, 0.010], atol=1e-12)


def test_the_parallax_of_a_feature_is_between_where_it_was_seen_first_and_last():
    """20 frames of a metre a second across; features 5 m ahead, seen all along, for 4 frames, and by two cameras."""
    rig = packaged_calibration("euroc", cameras=RIGS["stereo"])
    selector, image, zero = KeyframeSelector(rig, 30.0), np.zeros((10, 10), np.uint8), np.zeros(3)
    left, right = rig.cameras
    baseline = right.p_BC - left.p_BC
    ahead, across = left.R_BC @ np.array([0.0, 0.0, 5.0]), left.R_BC @ np.array([1.0, 0.0, 0.0])
    keyframes = []
    for k in range(24):
        t_ns = k * 50_000_000
        ids, camera = np.array([0, *([1, 2, 2] if k <= 4 else [])]), np.array([0, *([0, 0, 1] if k <= 4 else [])])
        xy, p_WF = np.zeros((len(ids), 2)), np.tile(left.p_BC + ahead, (3, 1))
        state = NavState(t_ns, np.eye(3), across * t_ns * 1e-9, across, zero, zero)
        estimate = Estimate(Status.TRACKING, state, np.arange(3), p_WF)
        keyframes += selector.add(Step(FrameSet(t_ns, (image,)), FrameTracks(t_ns, ids, camera, xy, xy), estimate, {}))
    apart = 0.2 * across + baseline
    by_two = np.arctan2(np.linalg.norm(np.cross(ahead, ahead - apart)), ahead @ (ahead - apart))
    # A second later, all is known of the first.
    expected = [np.arctan2(1.0, 5.0), np.arctan2(0.2, 5.0), by_two]
    np.testing.assert_allclose(keyframes[0].parallax, expected, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1])
def test_a_frame_that_sees_nothing_is_no_keyframe(count):
    """Another camera may go on seeing. What was seen but once is known by other means than parallax."""
    selector, zero, ids = KeyframeSelector(CALIBRATION, 30.0), np.zeros(3), np.arange(count)
    estimate = Estimate(Status.TRACKING, NavState(0, np.eye(3), zero, zero, zero, zero), ids, np.ones((count, 3)))
    tracks = FrameTracks(0, ids, ids, np.zeros((count, 2)), np.zeros((count, 2)))
    selector.add(Step(FrameSet(0, (np.zeros((10, 10), np.uint8),)), tracks, estimate, {}))
    keyframes = selector.flush()
    assert len(keyframes) == count
    assert all(np.isinf(keyframe.parallax).all() for keyframe in keyframes)
