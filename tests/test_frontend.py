"""The front-end on a rendered plane with known motion, on real images, and against detectors that misbehave."""

from collections import Counter
from itertools import combinations, pairwise

import cv2
import numpy as np
import pytest

from vioframe.errors import ConfigError, DatasetError, PluginError
from vioframe.evaluation.epipolar import epipolar_errors_px
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.frontend.equalisation import clahe, equalise
from vioframe.frontend.flow import body_rotation, predict
from vioframe.frontend.refill import GRID, spread, thin
from vioframe.geometry import so3, two_view
from vioframe.geometry.cameras import Camera
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.io.synchronise import synchronise
from vioframe.types import FrameSet, ImuSegment, Keypoints
from vioframe_euroc import EurocDataset
from vioframe_shi_tomasi import ShiTomasi

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, (0.0, 0.0, 0.0, 0.0), (320, 240))
R_BC = so3.exp([0.3, -1.2, 0.8])
CALIBRATION = packaged_calibration("euroc", cameras=["cam0"]).with_camera(0, model=CAMERA, R_BC=R_BC)
PERIOD_NS = 50_000_000


def texture(shape, seed=0, sigma=2.5):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=shape), (0, 0), sigma)
    return np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)


SKY = texture((1000, 1400))
SKY_TO_RAY = np.linalg.inv(np.array([[300.0, 0.0, 699.5], [0.0, 300.0, 499.5], [0.0, 0.0, 1.0]]))


def view(R_CS):
    """What a camera turned by ``R_CS`` sees of the infinitely far texture."""
    return cv2.warpPerspective(SKY, CAMERA.K @ R_CS @ SKY_TO_RAY, CAMERA.resolution)


def segment(rate_C, k=1, R_BC=R_BC):
    """The gyroscope's readings up to frame ``k`` while the camera turns at ``rate_C`` rad/s (its own frame)."""
    t_ns = k * PERIOD_NS + np.linspace(-PERIOD_NS, 0, 11).astype(np.int64)
    return ImuSegment(t_ns, np.tile(R_BC @ rate_C, (11, 1)), np.zeros((11, 3)))


STILL = np.zeros(3)


def play(frontend, images, rate_C=STILL, calibration=CALIBRATION):
    return [
        frontend.track(segment(rate_C, k), FrameSet(k * PERIOD_NS, (image,)), calibration)
        for k, image in enumerate(images, start=1)
    ]


def frontend(detector=None, incidents=None, calibration=CALIBRATION, **options):
    incidents = Incidents() if incidents is None else incidents
    return Frontend(detector or ShiTomasi(), calibration, FrontendOptions(**options), incidents)


def turning(rate_C, count):
    step = so3.exp(-rate_C * PERIOD_NS * 1e-9)  # R_C2C1
    R_CS, images = np.eye(3), []
    for _ in range(count):
        images.append(view(R_CS))
        R_CS = step @ R_CS
    return images, step


def test_tracks_follow_the_known_motion_to_a_tenth_of_a_pixel():
    rate_C = np.array([0.2, -0.4, 0.3])
    images, R_C2C1 = turning(rate_C, 8)
    steps = play(frontend(equalisation="none"), images, rate_C)
    for before, after in pairwise(steps):
        _, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
        expected = CAMERA.project(two_view.rays(before.xy_normalised[i]) @ R_C2C1.T)
        error = np.linalg.norm(after.xy[j] - expected, axis=1)
        assert len(error) > 80
        assert np.quantile(error, 0.95) < 0.1


def test_points_stay_on_their_landmarks_through_an_approach():
    """1 % nearer with every image, and half as bright in the end: KLT alone slides off by several times as much."""
    growth = 1.01 ** np.arange(25)
    images = [
        (view(np.diag([s, s, 1.0])) * brightness).astype(np.uint8)
        for s, brightness in zip(growth, np.linspace(1.0, 0.5, 25), strict=True)
    ]
    slid = {}
    for anchored in (True, False):
        first, *_, last = play(frontend(anchored=anchored, equalisation="none"), images)
        _, i, j = np.intersect1d(first.ids, last.ids, return_indices=True)
        middle = np.array([CAMERA.cx, CAMERA.cy])
        slid[anchored] = np.linalg.norm(last.xy[j] - middle - growth[-1] * (first.xy[i] - middle), axis=1)
        assert len(i) > 50
    assert np.median(slid[True]) < 0.06
    assert np.median(slid[True]) < 0.3 * np.median(slid[False])


def test_a_point_on_an_outline_is_let_go_of_before_it_slides():
    """Something else moves in front of what stands still: a patch on its outline shows both, and follows neither."""
    images = [view(np.eye(3)) for _ in range(20)]
    for k, image in enumerate(images):
        image[60:180, 40 + 4 * k : 140 + 4 * k] = texture((120, 100), seed=7)
    strayed = {}
    for anchored in (True, False):
        steps = play(frontend(anchored=anchored, equalisation="none", rejection="none", min_distance_px=6.0), images)
        off_px = []
        for (k, first), (m, later) in combinations(enumerate(steps), 2):
            _, i, j = np.intersect1d(first.ids, later.ids, return_indices=True)
            moved = later.xy[j] - first.xy[i]
            still, along = (np.linalg.norm(moved - [4.0 * images, 0.0], axis=1) for images in (0, m - k))
            off_px.append(np.minimum(still, along))
        strayed[anchored] = np.mean(np.concatenate(off_px) > 1.0)
    assert strayed[True] < 0.01
    assert strayed[True] < 0.2 * strayed[False]


def test_points_are_undistorted():
    camera = Camera(300.0, 300.0, 159.5, 119.5, (-0.28, 0.07, 2e-4, 2e-5), (320, 240))
    (tracks,) = play(frontend(calibration=CALIBRATION.with_camera(0, model=camera)), [view(np.eye(3))])
    np.testing.assert_allclose(camera.distort(tracks.xy_normalised), tracks.xy, atol=1e-6)
    assert np.abs(tracks.xy_normalised - (tracks.xy - [159.5, 119.5]) / 300.0).max() > 1e-3


def test_body_rotation_integrates_a_changing_rate():
    """For a rate that changes its axis, against the product over 2000 tiny steps."""
    t = np.linspace(0.0, 0.05, 2001)

    def rate_B(t):
        return np.stack([3.0 * np.cos(30.0 * t), 2.0 * np.sin(40.0 * t), 1.0 + 0.0 * t], axis=-1)

    R_B1B2 = np.eye(3)
    for step in so3.exp(rate_B(0.5 * (t[1:] + t[:-1])) * np.diff(t)[:, None]):
        R_B1B2 = R_B1B2 @ step
    t_ns = np.linspace(0, PERIOD_NS, 11).astype(np.int64)
    imu = ImuSegment(t_ns, rate_B(t_ns * 1e-9), np.zeros((11, 3)))
    difference = so3.log(body_rotation(imu).T @ R_B1B2)
    assert np.linalg.norm(difference) < 1e-3


def test_prediction_leaves_points_that_turn_out_of_view():
    xy = np.array([[10.0, 120.0], [160.0, 120.0]])
    guess = predict(CAMERA, xy, CAMERA.undistort(xy), so3.exp([0.0, -0.2, 0.0]))
    np.testing.assert_array_equal(guess[0], xy[0])
    assert guess[1, 0] < 110.0


@pytest.mark.parametrize("rate_C", [[0.0, 4.0, 0.0], [3.0, 0.0, 3.0]], ids=["yaw", "pitch and roll"])
def test_the_gyroscope_carries_tracks_through_fast_turns(rate_C):
    """12 degrees a frame, 60 px: beyond the reach of the pyramid alone, here without its upper levels."""
    rate_C = np.array(rate_C)
    images, _ = turning(rate_C, 2)
    kept = {}
    for known in (True, False):
        calibration = CALIBRATION.with_camera(0, rotation_known=known)
        first, second = play(frontend(klt_levels=1), images, rate_C, calibration)
        kept[known] = np.isin(first.ids, second.ids).mean()
    assert kept[True] > 0.6
    assert kept[False] < 0.2


@pytest.mark.parametrize("rejection", ["none", "fundamental", "magsac", "two_point"])
def test_standstill_keeps_every_track_where_it_is(rejection):
    steps = play(frontend(rejection=rejection), [view(np.eye(3))] * 20)
    np.testing.assert_array_equal(steps[0].ids, steps[-1].ids)
    assert np.abs(steps[0].xy - steps[-1].xy).max() < 0.01


@pytest.mark.parametrize("rejection", ["fundamental", "magsac", "two_point"])
def test_what_moves_by_itself_is_rejected(rejection):
    """The camera moves sideways before strips that are near and far by turns; a patch before all slides down."""
    walls, patch = [texture((240, 60), seed) for seed in range(8)], texture((80, 80), 9)
    images = []
    for k in range(4):
        # Nearer strips shift by 4 px a frame, farther ones by 2.
        image = np.hstack([wall[:, shift : shift + 40] for wall, shift in zip(walls, [2 * k, 4 * k] * 4, strict=True)])
        image[60 + 3 * k : 140 + 3 * k, 120:200] = patch
        images.append(image)
    first, *_, last = play(
        frontend(rejection=rejection, max_points=300, min_distance_px=8.0, refill_below=0.01), images
    )
    x, y = first.xy.T
    on_patch = (np.abs(x - 160) < 30) & (np.abs(y - 100) < 30)
    on_walls = (x % 40 > 20) & (x % 40 < 33) & (np.abs(y - 119.5) < 105) & (np.abs(x - 160) > 50)
    survives = np.isin(first.ids, last.ids)
    assert on_patch.sum() >= 10
    assert survives[on_patch].mean() < 0.1
    assert survives[on_walls].mean() > 0.8


def test_ids_grow_and_never_come_back():
    rate_C = np.array([0.0, 1.5, 0.5])
    images, _ = turning(rate_C, 12)
    images[6] = np.zeros_like(images[6])
    steps = play(frontend(), images, rate_C)
    newest, gone, alive = -1, set(), set()
    for tracks in steps:
        ids = tracks.ids.tolist()
        assert len(set(ids)) == len(ids)
        assert not gone.intersection(ids)
        new = [i for i in ids if i not in alive]
        assert new == sorted(new)
        assert all(i > newest for i in new)
        newest = max([newest, *new])
        gone |= alive.difference(ids)
        alive = set(ids)
    assert newest > 200


@pytest.mark.parametrize("level", [0, 255], ids=["black", "saturated"])
def test_an_image_that_shows_nothing_ends_the_tracks_and_is_counted(level):
    incidents = Incidents()
    seen = view(np.eye(3))
    empty = np.full_like(seen, level)
    steps = play(frontend(incidents=incidents), [seen, empty, seen])
    assert [len(s.ids) > 50 for s in steps] == [True, False, True]
    assert len(steps[1].ids) == 0
    assert steps[2].ids.min() > steps[0].ids.max()
    assert incidents.counts["featureless_image"] == 1


@pytest.mark.parametrize(
    "image", [np.zeros((480, 752), np.uint8), np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.uint16)]
)
def test_an_image_that_does_not_fit_the_calibration_is_refused(image):
    with pytest.raises(DatasetError, match="320x240"):
        play(frontend(), [image])


class Scripted:
    """A detector that answers as it is told, then keeps to the last answer."""

    def __init__(self, *answers):
        self._answers = list(answers)

    def detect(self, image, max_points):
        answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer(image, max_points) if callable(answer) else answer


def keypoints(*xy):
    return Keypoints(np.array(xy, np.float32).reshape(-1, 2), np.ones(len(xy), np.float32))


GOOD = ShiTomasi().detect
MISBEHAVIOURS = {
    "nothing": (keypoints(), "detector_found_nothing"),
    "NaN": (keypoints((np.nan, 50), (60, 60)), "detector_points_not_finite"),
    "infinite": (keypoints((50, np.inf), (60, 60)), "detector_points_not_finite"),
    "outside": (keypoints((-5, 50), (400, 10), (1e30, 10), (60, 60)), "detector_points_outside"),
    "too many": (lambda image, n: keypoints(*([60, 60] for _ in range(n + 1))), "detector_too_many_points"),
    "flat": (Keypoints(np.zeros(8, np.float32), np.ones(8, np.float32)), "detector_failed"),
    "three columns": (Keypoints(np.zeros((8, 3), np.float32), np.ones(8, np.float32)), "detector_failed"),
    "None": (None, "detector_failed"),
    "text": (Keypoints(np.array([["a", "b"]]), np.ones(1, np.float32)), "detector_failed"),
    "raises": (RuntimeError("out of memory\nand more"), "detector_failed"),
}


@pytest.mark.parametrize(("answer", "kind"), MISBEHAVIOURS.values(), ids=MISBEHAVIOURS)
def test_a_misbehaving_detector_is_survived_and_counted(answer, kind):
    incidents = Incidents()
    detector = Scripted(GOOD, answer)
    steps = play(
        frontend(detector, incidents, refill_below=1.0, max_points=400),
        [view(np.eye(3))] * 4,
    )
    assert incidents.counts[kind] >= 1
    assert np.isin(steps[0].ids, steps[-1].ids).all()
    for tracks in steps:
        assert np.isfinite(tracks.xy).all()
        assert np.isfinite(tracks.xy_normalised).all()
        assert CAMERA.contains(tracks.xy).all()


def test_a_detector_that_never_works_is_an_error_of_the_plugin():
    incidents = Incidents()
    broken = frontend(Scripted(RuntimeError("no weights")), incidents)
    play(broken, [view(np.eye(3))] * 9)
    assert incidents.counts["detector_failed"] == 9
    with pytest.raises(PluginError, match=r"Scripted failed .* 10 calls .*no weights"):
        play(broken, [view(np.eye(3))])


def test_a_detector_that_has_worked_may_fail_for_long():
    incidents = Incidents()
    play(
        frontend(Scripted(GOOD, RuntimeError("busy")), incidents, refill_below=1.0, max_points=400),
        [view(np.eye(3))] * 15,
    )
    assert incidents.counts["detector_failed"] == 14


def test_the_image_that_a_detector_gets_is_read_only():
    """It is the one that is tracked in, and with ``equalisation: none`` the data set's own."""

    def scribble(image, max_points):
        image[:] = 0

    for equalisation in ("clahe", "none"):
        incidents, image = Incidents(), view(np.eye(3))
        kept = image.copy()
        play(frontend(Scripted(GOOD, scribble), incidents, equalisation=equalisation, max_points=400), [image] * 3)
        assert incidents.counts["detector_failed"] == 2
        assert "read-only" in incidents.notes[0]["detail"]
        np.testing.assert_array_equal(image, kept)


def test_what_was_prepared_is_not_made_again_and_the_points_are_the_same(monkeypatch):
    made = []

    def counted(image, *args):
        made.append(image)
        return equalise(image, *args)

    monkeypatch.setattr("vioframe.frontend.view.equalise", counted)
    frames = [FrameSet(k * PERIOD_NS, (texture((240, 320)),)) for k in range(1, 5)]
    of_another_size = FrameSet(5 * PERIOD_NS, (np.zeros((24, 32), np.uint8),))
    at_once, beforehand = frontend(), frontend()
    expected = [at_once.track(segment(STILL, k), f, CALIBRATION) for k, f in enumerate(frames, start=1)]
    for f in (*frames, of_another_size):
        beforehand.prepare(f)
    assert len(made) == 8
    for k, f in enumerate(frames, start=1):
        tracks = beforehand.track(segment(STILL, k), f, CALIBRATION)
        np.testing.assert_array_equal(tracks.xy, expected[k - 1].xy)
        assert beforehand.stage_seconds["equalise"] > 0.0
    assert len(made) == 8
    with pytest.raises(DatasetError, match="image is 32x24"):
        beforehand.track(segment(STILL, 5), of_another_size, CALIBRATION)


def test_frames_that_never_get_their_turn_are_not_kept():
    followed = frontend()
    for k in range(1, 101):
        followed.prepare(FrameSet(k * PERIOD_NS, (texture((240, 320)),)))
    assert len(followed._prepared) < 10
    followed.track(segment(STILL, 101), FrameSet(101 * PERIOD_NS, (texture((240, 320)),)), CALIBRATION)
    assert not followed._prepared


def test_the_detector_is_asked_only_when_tracks_are_missing():
    calls = []
    detector = Scripted(lambda image, n: calls.append(n) or GOOD(image, n))
    play(frontend(detector, max_points=60), [view(np.eye(3))] * 5)
    assert len(calls) == 1


def test_new_points_keep_their_distance_and_spread():
    tracks = play(frontend(max_points=96, min_distance_px=12.0), [view(np.eye(3))])[0]
    gap = np.linalg.norm(tracks.xy[:, None] - tracks.xy[None], axis=2)
    assert gap[np.triu_indices(len(gap), 1)].min() >= 12.0
    rows, columns = GRID
    cells = Counter(map(tuple, (tracks.xy // [320 / columns, 240 / rows]).astype(int)))
    assert len(cells) == rows * columns
    assert max(cells.values()) - min(cells.values()) <= 1


def test_points_that_are_lost_at_once_do_not_keep_others_out():
    """In every cell of the refill's grid a strip looks anew each time, and what lies on it is the strongest."""
    still, wide = view(np.eye(3)), 320 // GRID[1]
    flickering = np.arange(320) % wide >= wide - 12

    def seen(k: int) -> np.ndarray:
        image = still.copy()
        image[:, flickering] = np.random.default_rng(k).integers(0, 256, (240, flickering.sum()))
        return image

    rng, cells = np.random.default_rng(0), wide * np.arange(GRID[1])
    lost, lasting = (
        np.column_stack([np.repeat(cells, 20) + rng.uniform(*reach, 160), rng.uniform(10.0, 230.0, 160)])
        for reach in ((wide - 8, wide - 4), (8, 14))
    )
    detector = Scripted(lambda image, n: keypoints(*np.vstack([lost, lasting])[:n]))
    tracks = play(frontend(detector, max_points=60, min_distance_px=3.0, klt_levels=0), map(seen, range(15)))[-1]
    assert np.mean(tracks.xy[:, 0] % wide < wide // 2) > 0.8


def test_spread_fills_the_emptiest_cell_with_the_first_in_it():
    candidates = np.array([[10, 10], [30, 10], [80, 10], [70, 30], [20, 80]], float)
    live = np.array([[90, 90], [40, 90]], float)
    taken = spread(candidates, live, 3, size=(100, 100), grid=(2, 2), min_distance_px=5.0)
    np.testing.assert_array_equal(taken, [0, 2, 1])


def test_spread_stays_away_from_live_tracks():
    candidates = np.array([[10, 10], [50, 50]], float)
    live = np.array([[14, 10]], float)
    taken = spread(candidates, live, 5, size=(100, 100), grid=(1, 1), min_distance_px=5.0)
    np.testing.assert_array_equal(taken, [1])


def test_of_two_tracks_that_meet_the_older_stays():
    xy = np.array([[10, 10], [12, 10], [14, 10], [50, 50]], float)
    # 9 goes for 3; 4 would only have to go for 9, which is gone.
    np.testing.assert_array_equal(thin(xy, np.array([3, 9, 4, 8]), 3.0), [True, False, True, True])


@pytest.mark.parametrize("equalisation", ["clahe", "histogram"])
def test_equalisation_finds_points_in_a_dim_image(equalisation):
    """FAST asks for a contrast in grey levels, which a dim image does not have."""
    from vioframe_fast import Fast

    dim = (view(np.eye(3)) // 8 + 20).astype(np.uint8)
    found = {
        method: len(play(frontend(Fast(threshold=20), equalisation=method), [dim])[0].ids)
        for method in ("none", equalisation)
    }
    assert found["none"] < 10
    assert found[equalisation] > 50


def test_the_answer_belongs_to_the_caller():
    twin, other = frontend(), frontend()
    images = [view(np.eye(3))] * 3
    expected = play(twin, images)[-1]
    for k, image in enumerate(images, start=1):
        tracks = other.track(segment(STILL, k), FrameSet(k * PERIOD_NS, (image,)), CALIBRATION)
        kept = tracks.xy.copy()
        tracks.xy[:] = 0.0
        tracks.ids[:] = 0
        tracks.xy_normalised[:] = 0.0
    np.testing.assert_array_equal(kept, expected.xy)


@pytest.mark.parametrize(
    "bad",
    [
        {"max_points": 0},
        {"equalisation": "gamma"},
        {"klt_window_px": 20},
        {"rejection": "ransac"},
        {"refill_below": 0.0},
        {"min_distance_px": -1.0},
        {"rejection_px": 0.0},
    ],
    ids=str,
)
def test_an_option_out_of_range_is_refused_by_name(bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        FrontendOptions(**bad)


# ---- real images -----------------------------------------------------------------------------------------------------


def euroc(shared_data, name, frames, **options):
    """The data set and its tracks of the first ``frames`` frames, as (segment, tracks) pairs."""
    dataset = EurocDataset(shared_data / "euroc" / name, cameras="cam0")
    incidents = Incidents()
    tracker = frontend(incidents=incidents, calibration=dataset.calibration, **options)
    packets = synchronise(dataset.measurements(), duration_s=frames / 20.0, incidents=incidents)
    return dataset, [tracker.track(imu, frames, dataset.calibration) for imu, frames in packets]


def test_two_runs_are_byte_identical(shared_data):
    for rejection in ("fundamental", "magsac", "two_point"):
        first, second = (euroc(shared_data, "MH_01_easy_15s", 10, rejection=rejection)[1] for _ in range(2))
        for a, b in zip(first, second, strict=True):
            assert a.ids.tobytes() == b.ids.tobytes()
            assert a.xy.tobytes() == b.xy.tobytes()


def test_at_rest_tracks_live_on(shared_data):
    """The whole view shifts by 1.8 px as the vehicle settles; tracks keep to it and to each other for 95 frames."""
    _, steps = euroc(shared_data, "V1_01_easy_rest", 95)
    assert len(steps) >= 90
    survivors, i, j = np.intersect1d(steps[0].ids, steps[-1].ids, return_indices=True)
    assert len(survivors) >= 0.8 * len(steps[0].ids)
    moved = steps[-1].xy[j] - steps[0].xy[i]
    assert np.median(np.linalg.norm(moved - np.median(moved, axis=0), axis=1)) < 0.4


def test_in_flight_tracks_obey_the_true_epipolar_geometry(shared_data):
    """Against the recorded ground truth, whose own error is part of what is measured."""
    dataset, steps = euroc(shared_data, "MH_01_easy_15s", 100)
    for baseline, median_px, outliers in ((1, 0.2, 0.005), (5, 0.8, 0.1)):
        error_px = epipolar_errors_px(steps, dataset.ground_truth, dataset.calibration, baseline)
        assert np.median(error_px) < median_px
        assert (error_px > 3.0).mean() < outliers
    lifetimes = np.bincount(np.concatenate([s.ids for s in steps]))
    assert lifetimes.mean() > 8.0


def test_a_gap_between_images_restarts_lost_tracks(shared_data):
    """Half a second without images: what cannot be found again is replaced, and nothing is tracked to a wrong place."""
    dataset = EurocDataset(shared_data / "euroc" / "MH_01_easy_15s", cameras="cam0")
    incidents = Incidents()
    tracker = frontend(incidents=incidents, calibration=dataset.calibration)

    def with_gap():
        start = None
        for item in dataset.measurements():
            if isinstance(item, FrameSet):
                start = item.t_ns if start is None else start
                if 0.5 < (item.t_ns - start) * 1e-9 < 1.0:
                    continue
            yield item

    packets = synchronise(with_gap(), duration_s=1.5, incidents=incidents)
    counts = [len(tracker.track(imu, frames, dataset.calibration).ids) for imu, frames in packets]
    assert incidents.counts["camera_gap"] == 1
    assert min(counts) >= 120


@pytest.mark.parametrize("shape", [(480, 752), (123, 77), (64, 65), (9, 9)])
@pytest.mark.parametrize("contrast", [1.0, 0.1])
def test_contrast_is_spread_as_opencv_does(shape: tuple[int, int], contrast: float):
    rng = np.random.default_rng(3)
    smooth = cv2.GaussianBlur(rng.uniform(0.0, 255.0, shape), (0, 0), 3.0)
    image = np.clip(128.0 + contrast * (4.0 * (smooth - 128.0) + rng.normal(0.0, 3.0, shape)), 0, 255).astype(np.uint8)
    image.flags.writeable = False
    np.testing.assert_array_equal(clahe(image), cv2.createCLAHE(3.0, (8, 8)).apply(image))


def test_an_image_without_contrast_stays_so():
    assert len(np.unique(clahe(np.full((64, 64), 7, np.uint8)))) == 1


class Ranking:
    """Whole pixels 8 px apart in an order that says nothing of where they lie."""

    def __init__(self):
        x, y = np.meshgrid(np.arange(10, 312, 8), np.arange(10, 232, 8))
        self.xy = np.random.default_rng(0).permutation(np.column_stack([x.ravel(), y.ravel()])).astype(np.float32)

    def detect(self, image, max_points):
        return Keypoints(self.xy[:max_points], np.linspace(1.0, 0.0, len(self.xy[:max_points]), dtype=np.float32))


@pytest.mark.parametrize("knows", [True, False])
def test_of_a_detector_that_knows_what_will_be_followed_the_first_are_taken(knows):
    detector = Ranking()
    if knows:
        detector.best_first = True
    (tracks,) = play(frontend(detector, max_points=100, min_distance_px=8.0), [view(np.eye(3))])
    rank = {tuple(xy): n for n, xy in enumerate(detector.xy[:600].tolist())}
    taken = np.array([rank[tuple(xy)] for xy in tracks.xy.tolist()])
    assert len(taken) == 100
    # A hundred of six hundred, two or three of each cell.
    assert (np.median(taken) < 120) == knows
    assert (taken.max() < 400) == knows
