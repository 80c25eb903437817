"""The pose graph: its mathematics, what it does with drift and with wrong loops, and the frames between keyframes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from vioframe.geometry.so3 import rotation_z
from vioframe_pose_graph.closer import carry
from vioframe_pose_graph.consistency import _TIMES, Odometry, corrected, measured
from vioframe_pose_graph.graph import Edges, mahalanobis_squared, residuals, solve, solve_robustly, uncertainty
from vioframe_pose_graph.options import PoseGraphOptions
from vioframe_pose_graph.recognition import Sighting
from vioframe_pose_graph.verification import Relation

# The odometry of these tests drifts a few times as fast as a good one.
OPTIONS = PoseGraphOptions(position_drift=0.1)


def circle(laps: int, per_lap: int = 40, radius: float = 5.0):
    """Stamps, true positions (N, 3) and yaws (N,) of a flight round a circle that climbs and sinks."""
    angle = np.arange(laps * per_lap + 1) * (2.0 * np.pi / per_lap)
    p = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.5 * np.sin(2.0 * angle)])
    t_ns = 10**9 + np.arange(len(p)) * 400_000_000
    return t_ns, p, angle


def drifted(p, rng, sigma_m=0.05, sigma_yaw=0.004):
    """``p`` as an odometry sees it, and the yaw (N,) that it is off by."""
    yaw = np.concatenate([[0.0], np.cumsum(rng.normal(0.0, sigma_yaw, len(p) - 1))])
    steps = np.einsum("nij,nj->ni", np.array([rotation_z(a) for a in yaw[:-1]]), np.diff(p, axis=0))
    steps += rng.normal(0.0, sigma_m, steps.shape)
    return np.concatenate([p[:1], p[0] + np.cumsum(steps, axis=0)]), yaw


def true_loops(p, yaw_error, pairs, sigma=(0.02, 0.003), rng=None):
    """Edges that say where ``pairs`` (L, 2) truly lie to one another, in the axes of the odometry at the first."""
    i, j = np.array(pairs).T
    z = np.array([rotation_z(yaw_error[a]) @ (p[b] - p[a]) for a, b in pairs])
    turn = yaw_error[i] - yaw_error[j]
    if rng is not None:
        z, turn = z + rng.normal(0.0, sigma[0], z.shape), turn + rng.normal(0.0, sigma[1], turn.shape)
    cov = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2])
    return Edges(i, j, z, turn, np.repeat(cov[None], len(i), axis=0))


def every(loops):
    return np.ones(len(loops), bool)


def random_edges(rng, nodes=6, count=12):
    i = rng.integers(0, nodes, count)
    j = (i + rng.integers(1, nodes, count)) % nodes
    A = rng.standard_normal((count, 4, 4))
    cov = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(4)
    return Edges(i, j, rng.standard_normal((count, 3)), rng.uniform(-3.0, 3.0, count), cov)


def test_a_loop_is_as_sure_as_its_fit_and_less_the_farther_its_views_are_apart():
    def covariance(way_m, sigma_m, yaw_deg):
        fit = np.diag([sigma_m**2] * 3 + [np.radians(yaw_deg) ** 2])
        loops = measured([Sighting(0, 1, Relation(np.array([0.6, 0.0, 0.8]) * way_m, 0.1, fit, 50))])
        np.testing.assert_array_equal(loops.cov[0], np.diag(np.diag(loops.cov[0])))
        return np.sqrt(np.diag(loops.cov[0]))

    near, far = covariance(0.0, 0.0, 0.0), covariance(4.0, 0.0, 0.0)
    np.testing.assert_allclose(near[:3], 0.0005)
    np.testing.assert_allclose(far[:3], np.hypot(0.0005, 0.012))
    np.testing.assert_allclose([near[3], far[3]], np.radians(0.01))
    # The points of a fit are wrong together: it is off by more than it says.
    np.testing.assert_allclose(
        covariance(0.0, 0.03, 0.5), np.hypot(near, 2.0 * np.array([0.03] * 3 + [np.radians(0.5)]))
    )


def test_the_whitened_square_is_the_mahalanobis_distance():
    rng = np.random.default_rng(0)
    edges = random_edges(rng)
    r = residuals(np.zeros((6, 3)), np.zeros(6), edges)[0]
    error = np.column_stack([-edges.z, -edges.turn])
    np.testing.assert_allclose(np.sum(r**2, axis=1), mahalanobis_squared(error, edges.cov), rtol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_the_derivatives_on_the_manifold(seed):
    rng = np.random.default_rng(seed)
    edges = random_edges(rng)
    p, yaw = rng.normal(0.0, 5.0, (6, 3)), rng.uniform(-np.pi, np.pi, 6)
    _, J_i, J_j = residuals(p, yaw, edges)
    h = 1e-6
    for k in range(4):
        for nodes, J in ((edges.i, J_i), (edges.j, J_j)):
            numeric = np.empty((len(edges), 4))
            for e, node in enumerate(nodes):
                moved = []
                for sign in (1.0, -1.0):
                    q, turned = p.copy(), yaw.copy()
                    if k < 3:
                        q[node, k] += sign * h
                    else:
                        turned[node] += sign * h
                    moved.append(residuals(q, turned, edges)[0][e])
                numeric[e] = (moved[0] - moved[1]) / (2.0 * h)
            np.testing.assert_allclose(J[:, :, k], numeric, atol=1e-6)


def test_turning_and_moving_everything_changes_no_residual():
    """The four directions that no edge can see are those of the odometry: position and yaw of the whole."""
    rng = np.random.default_rng(1)
    edges = random_edges(rng)
    p, yaw = rng.normal(0.0, 5.0, (6, 3)), rng.uniform(-np.pi, np.pi, 6)
    R = rotation_z(0.7)
    moved = residuals(p @ R.T + [3.0, -2.0, 1.0], yaw + 0.7, edges)[0]
    np.testing.assert_allclose(moved, residuals(p, yaw, edges)[0], atol=1e-12)


def test_whole_turns_change_no_residual():
    rng = np.random.default_rng(9)
    edges = random_edges(rng)
    p, yaw = rng.normal(0.0, 5.0, (6, 3)), rng.uniform(-np.pi, np.pi, 6)
    expected = residuals(p, yaw, edges)[0]
    around = yaw + 2.0 * np.pi * np.array([0, 1, -1, 0, 2, -1])
    np.testing.assert_allclose(residuals(p, around, edges)[0], expected, atol=1e-10)
    other = replace(edges, turn=edges.turn - 2.0 * np.pi)
    np.testing.assert_allclose(residuals(p, yaw, other)[0], expected, atol=1e-10)


def test_the_graph_goes_the_shorter_way_round_where_yaw_wraps():
    """Two nodes, measured to be turned by just less than half a turn one way, seem so by just less the other way."""
    cov = np.eye(4)[None]
    edge = Edges(np.array([0]), np.array([1]), np.array([[1.0, 0.0, 0.0]]), np.array([np.pi - 0.1]), cov)
    _, yaw = solve(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([0.0, -np.pi + 0.1]), edge)
    np.testing.assert_allclose(yaw, [0.0, -np.pi - 0.1], atol=1e-6)


def test_exact_loops_restore_the_truth():
    t_ns, p, _ = circle(laps=1)
    rng = np.random.default_rng(2)
    odometry, yaw_error = drifted(p, rng)
    # Every keyframe tied to the first leaves nothing open.
    loops = true_loops(p, yaw_error, [(0, j) for j in range(1, len(p))], sigma=(1e-4, 1e-5))
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS)
    edges = graph.edges() + loops
    q, yaw = solve(odometry, np.zeros(len(p)), edges)
    np.testing.assert_allclose(q, p, atol=1e-3)
    np.testing.assert_allclose(yaw, -yaw_error, atol=1e-3)


def test_the_graph_finds_its_minimum_from_afar():
    """Yaw errors of a radian, as after a reset: the gradient vanishes where it ends."""
    t_ns, p, _ = circle(laps=1)
    rng = np.random.default_rng(3)
    odometry, yaw_error = drifted(p, rng, sigma_yaw=0.1)
    loops = true_loops(p, yaw_error, [(0, 40), (1, 39), (2, 38)])
    edges = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS).edges() + loops
    q, yaw = solve(odometry, np.zeros(len(p)), edges)
    r, J_i, J_j = residuals(q, yaw, edges)
    gradient = np.zeros((len(p), 4))
    np.add.at(gradient, edges.i, np.einsum("eki,ek->ei", J_i, r))
    np.add.at(gradient, edges.j, np.einsum("eki,ek->ei", J_j, r))
    begin, B_i, B_j = residuals(odometry, np.zeros(len(p)), edges)
    first = np.zeros((len(p), 4))
    np.add.at(first, edges.i, np.einsum("eki,ek->ei", B_i, begin))
    np.add.at(first, edges.j, np.einsum("eki,ek->ei", B_j, begin))
    assert np.abs(gradient[1:]).max() < 1e-3 * np.abs(first[1:]).max()
    assert np.array_equal(q[0], odometry[0])
    assert yaw[0] == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_three_laps_lose_most_of_their_drift(seed):
    """A circle flown three times: the last keyframe, seen again, is where it belongs to within a fifth of the drift."""
    t_ns, p, _ = circle(laps=3)
    rng = np.random.default_rng(seed)
    odometry, yaw_error = drifted(p, rng)
    pairs = [(j - 40, j) for j in range(45, len(p), 5)] + [(0, len(p) - 1)]
    loops = true_loops(p, yaw_error, pairs, rng=rng)
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS)
    q, _, used = solve_robustly(odometry, graph.edges(), loops, every(loops))
    assert used.all()
    before, after = (np.linalg.norm(x[-1] - p[-1]) for x in (odometry, q))
    assert after < 0.2 * before
    rms = [np.sqrt(np.mean(np.sum((x - p) ** 2, axis=1))) for x in (odometry, q)]
    assert rms[1] < 0.5 * rms[0]


@pytest.mark.parametrize("seed", range(5))
def test_wrong_loops_are_let_go(seed):
    """Ten right loops and five wrong ones, of which no two agree."""
    t_ns, p, _ = circle(laps=2)
    rng = np.random.default_rng(seed)
    odometry, yaw_error = drifted(p, rng)
    right = true_loops(p, yaw_error, [(j - 40, j) for j in range(40, 80, 4)], rng=rng)
    wrong = true_loops(p, yaw_error, [(j - 30, j) for j in range(42, 80, 8)])
    wrong.z[:] += rng.choice([-1.0, 1.0], wrong.z.shape) * rng.uniform(1.0, 3.0, wrong.z.shape)
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS)
    both = right + wrong
    q, yaw, used = solve_robustly(odometry, graph.edges(), both, every(both))
    assert used.tolist() == [True] * len(right) + [False] * len(wrong)
    alone, alone_yaw, _ = solve_robustly(odometry, graph.edges(), right, every(right))
    np.testing.assert_allclose(q, alone, atol=1e-3)
    np.testing.assert_allclose(yaw, alone_yaw, atol=1e-3)


def test_the_distance_to_the_rest_is_that_of_leaving_the_loop_out():
    """``r^T (I - S)^-1 r`` of the solution with the loop, against solving without it: equal where all is linear."""
    t_ns, p, _ = circle(laps=2)
    rng = np.random.default_rng(7)
    odometry, yaw_error = drifted(p, rng, sigma_m=0.005, sigma_yaw=0.0)
    loops = true_loops(p, yaw_error, [(0, 40), (10, 50), (20, 60), (30, 70)], rng=rng)
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS).edges()
    q, yaw = solve(odometry, np.zeros(len(p)), graph + loops)
    for k in range(len(loops)):
        one = loops.select(np.arange(len(loops)) == k)
        rest = graph + loops.select(np.arange(len(loops)) != k)
        r = residuals(q, yaw, one)[0][0]
        within = uncertainty(q, yaw, graph + loops, one)[0]
        q_rest, yaw_rest = solve(odometry, np.zeros(len(p)), rest)
        innovation = residuals(q_rest, yaw_rest, one)[0][0]
        left_out = np.eye(4) + uncertainty(q_rest, yaw_rest, rest, one)[0]
        expected = innovation @ np.linalg.solve(left_out, innovation)
        assert r @ np.linalg.solve(np.eye(4) - within, r) == pytest.approx(expected, rel=0.02)


def test_a_doubted_loop_is_used_if_the_others_bear_it_out():
    t_ns, p, _ = circle(laps=2)
    rng = np.random.default_rng(8)
    odometry, yaw_error = drifted(p, rng)
    loops = true_loops(p, yaw_error, [(2, 42), (4, 44), (6, 46), (8, 48)], rng=rng)
    loops.z[3] += [2.0, 0.0, 0.0]
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS)
    trusted = np.array([True, True, False, False])
    _, _, used = solve_robustly(odometry, graph.edges(), loops, trusted)
    assert used.tolist() == [True, True, True, False]


def test_without_loops_nothing_moves():
    t_ns, p, _ = circle(laps=1)
    graph = Odometry.of(t_ns, p, np.zeros(len(p), int), OPTIONS)
    nothing = np.empty(0, np.int64)
    empty = Edges(nothing, nothing, np.empty((0, 3)), np.empty(0), np.empty((0, 4, 4)))
    q, yaw, _ = solve_robustly(p, graph.edges(), empty, every(empty))
    assert np.array_equal(q, p)
    assert not yaw.any()


def test_four_edges_are_as_stiff_as_the_random_walk():
    """The covariance of the end of a long straight chain of edges is that of the walk, but for its two ends."""
    n = 200
    p = np.column_stack([np.linspace(0.0, 100.0, n), np.zeros((n, 2))])
    graph = Odometry.of(10**9 * np.arange(1, n + 1), p, np.zeros(n, int), OPTIONS)
    edges = graph.edges()
    _, J_i, J_j = residuals(p, np.zeros(n), edges)
    H = np.zeros((n, n))  # of the heights, which no other coordinate has a part in
    for e, (i, j) in enumerate(zip(edges.i, edges.j, strict=True)):
        a, b = J_i[e, :, 2], J_j[e, :, 2]
        H[i, i] += a @ a
        H[j, j] += b @ b
        H[i, j] += a @ b
        H[j, i] += a @ b
    variance = np.linalg.inv(H[1:, 1:])[-1, -1]
    assert variance == pytest.approx(graph.drift[:, 2, 2].sum(), rel=0.05)


def test_the_covariance_of_the_odometry_is_that_of_a_simulated_one():
    t_ns, p, _ = circle(laps=1)
    graph = Odometry.of(t_ns, p, np.zeros(len(p), int), OPTIONS)
    rng = np.random.default_rng(4)
    i, j, trials = 5, 33, 20_000
    steps = np.diff(p, axis=0)[i:j]
    yaw = np.cumsum(rng.standard_normal((trials, j - i)) * np.sqrt(graph.drift[i + 1 : j + 1, 3, 3]), axis=1)
    # A step is turned by what the yaw was off before it.
    before = np.concatenate([np.zeros((trials, 1)), yaw[:, :-1]], axis=1)
    cos, sin = np.cos(before), np.sin(before)
    x = (cos * steps[:, 0] - sin * steps[:, 1]).sum(axis=1)
    y = (sin * steps[:, 0] + cos * steps[:, 1]).sum(axis=1)
    noise = rng.standard_normal((trials, 3)) * np.sqrt(graph.drift[i + 1 : j + 1, 2, 2].sum())
    ends = np.column_stack([x, y, np.full(trials, steps[:, 2].sum())]) + noise
    measured = np.cov(np.column_stack([ends, yaw[:, -1]]).T)
    expected = graph.cov(np.array([i]), np.array([j]))[0]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(measured / scale, expected / scale, atol=0.05)


def test_fewer_keyframes_drift_as_far():
    t_ns, p, _ = circle(laps=1)
    segment = (np.arange(len(p)) >= 20).astype(int)
    graph, which = Odometry.of(t_ns, p, segment, OPTIONS), np.array([0, 3, 11, 12, 25, 40])
    few = graph.at(which)
    assert np.array_equal(few.p, p[which])
    i, j = np.triu_indices(len(which))
    np.testing.assert_allclose(few.cov(i, j), graph.cov(which[i], which[j]), rtol=1e-9, atol=1e-9)
    few, graph = few.as_told(2.0), graph.as_told(2.0)
    np.testing.assert_allclose(few.cov(i, j), graph.cov(which[i], which[j]), rtol=1e-9, atol=1e-9)


def claimed(p, added, first):
    """(N, 4, 4) what a filter says of [position yaw] whose steps added ``added`` (N, 4, 4) to ``first`` (4, 4)."""
    cov = [first]
    for step, more in zip(np.diff(p, axis=0), added[1:], strict=True):
        F = np.eye(4)
        F[:2, 3] = -step[1], step[0]
        cov.append(F @ cov[-1] @ F.T + more)
    return np.array(cov)


def test_the_odometry_drifts_by_what_its_back_end_says():
    """What each step added is found again, whatever was unknown before; and counted as often as is asked for."""
    t_ns, p, _ = circle(laps=1)
    rng, segment = np.random.default_rng(8), np.zeros(len(p), int)
    A = rng.standard_normal((len(p), 4, 4)) * [[0.05], [0.05], [0.05], [0.01]]
    added = A @ A.transpose(0, 2, 1)
    said = claimed(p, added, np.diag([4.0, 4.0, 4.0, 0.3]))
    least = {"position_drift": 1e-9, "yaw_drift_deg": 1e-9}
    once, thrice = (
        Odometry.of(t_ns, p, segment, PoseGraphOptions(overconfidence=k, **least), said) for k in (1.0, 3.0)
    )
    np.testing.assert_allclose(once.drift[1:], added[1:], atol=1e-9)
    np.testing.assert_allclose(thrice.drift, 9.0 * once.drift, atol=1e-9)
    # Which concerns the limit alone: what it says is what it says, and at least what the best drift by.
    np.testing.assert_array_equal(thrice.told, once.told)
    beside = np.diagonal(once.told - added, axis1=1, axis2=2)[1:]
    np.testing.assert_allclose(beside, np.square([[0.001] * 3 + [np.radians(0.003)]]) * least_way(t_ns, p), atol=1e-12)
    relative = claimed(p[10:31], added[10:31], np.zeros((4, 4)))[-1]
    np.testing.assert_allclose(once.cov(np.array([10]), np.array([30]))[0], relative, atol=1e-8)


def least_way(t_ns, p):
    """(N - 1, 4) what the least drift of each step grows with: metres, some of them for hovering, and seconds."""
    seconds = np.diff(t_ns) * 1e-9
    way = np.linalg.norm(np.diff(p, axis=0), axis=1) + 0.1 * seconds
    return np.column_stack([way, way, way, seconds])


def test_images_that_told_more_than_was_lost_have_moved_the_estimate_by_as_much():
    t_ns, p, _ = circle(laps=1)
    segment = np.zeros(len(p), int)
    said = claimed(p, np.tile(1e-4 * np.eye(4), (len(p), 1, 1)), 0.1 * np.eye(4))
    walk = Odometry.of(t_ns, p, segment, OPTIONS).drift
    shrunk = said.copy()
    shrunk[20:] *= 0.5
    moved = Odometry.of(t_ns, p, segment, OPTIONS, shrunk)
    assert np.linalg.eigvalsh(moved.drift[20] - walk[20]).min() > -1e-12
    least = np.diag(np.square([0.001] * 3 + [np.radians(0.003)]) * least_way(t_ns, p)[19])
    F = np.eye(4)
    F[:2, 3] = p[19, 1] - p[20, 1], p[20, 0] - p[19, 0]
    np.testing.assert_allclose(moved.told[20], F @ said[19] @ F.T - shrunk[20] + least, atol=1e-12)
    unknown = said.copy()
    unknown[12] = np.nan
    odometry = Odometry.of(t_ns, p, segment, OPTIONS, unknown)
    drift = odometry.drift
    np.testing.assert_array_equal(drift[12:14], walk[12:14])
    np.testing.assert_array_equal(odometry.told[12:14], walk[12:14])
    assert (np.trace(drift - odometry.told, axis1=1, axis2=2)[[11, 14]] > 0.0).all()
    assert (np.trace(drift[[11, 14]] - walk[[11, 14]], axis1=1, axis2=2) > 0.0).all()


def test_loops_count_as_an_eighth_of_what_they_would_if_their_points_were_not_the_same():
    """All agree, and what Cauchy's distribution makes of four errors that are none is five times their mean weight."""
    t_ns, p, _ = circle(laps=2)
    odometry, yaw_error = drifted(p, np.random.default_rng(3))
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS)
    loops = true_loops(p, yaw_error, [(2, 42), (12, 52), (22, 62)], sigma=(0.3, 0.05))
    path, yaw, believed = corrected(graph, loops, every(loops))
    left, _, _ = residuals(path, yaw, loops)
    worth = 5.0 / (1.0 + np.sum(left**2, axis=1))
    eighth = graph.as_told(_TIMES[0]).edges() + replace(loops, cov=(8.0 / worth)[:, None, None] * loops.cov)
    np.testing.assert_allclose(path, solve(odometry, np.zeros(len(p)), eighth)[0], atol=1e-3)
    assert believed.all()


def test_a_loop_that_is_far_off_counts_little():
    """By four standard deviations, which no gate tells from chance: three others know better."""
    t_ns, p, _ = circle(laps=2)
    odometry, yaw_error = drifted(p, np.random.default_rng(3))
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS)
    right = true_loops(p, yaw_error, [(2, 42), (12, 52), (22, 62), (30, 70)], sigma=(0.1, 0.02))
    z = right.z.copy()
    z[3, 2] += 0.4
    off = replace(right, z=z)
    best = corrected(graph, right, every(right))[0]
    path, _, believed = corrected(graph, off, every(off))
    alike = graph.as_told(_TIMES[0]).edges() + replace(off, cov=8.0 / 5.0 * off.cov)
    equal, _ = solve(odometry, np.zeros(len(p)), alike)
    assert believed.all()
    assert np.linalg.norm(path - best, axis=1).max() < 0.5 * np.linalg.norm(equal - best, axis=1).max()


def flown(seed, sigma_m, sigma_yaw, said_m, said_yaw, loop_sigma):
    """Root mean square errors, m, of an odometry and of its path with the loops of three laps.

    Its steps are off by ``sigma_m`` and ``sigma_yaw``, and it says by ``said_m`` and ``said_yaw``.
    """
    rng = np.random.default_rng(seed)
    t_ns, p, _ = circle(laps=3)
    odometry, yaw_error = drifted(p, rng, sigma_m, sigma_yaw)
    step = np.diag(np.square([said_m, said_m, said_m, said_yaw]))
    cov = claimed(odometry, np.tile(step, (len(p), 1, 1)), 1e-6 * np.eye(4))
    graph = Odometry.of(t_ns, odometry, np.zeros(len(p), int), OPTIONS, cov)
    loops = true_loops(p, yaw_error, [(i, i + 40) for i in range(1, 80, 2)], loop_sigma, rng)
    corrected_p, _, believed = corrected(graph, loops, every(loops))
    assert believed.all()
    return [np.sqrt(np.mean(np.sum((path - p) ** 2, axis=1))) for path in (odometry, corrected_p)]


def test_loops_do_not_harm_an_odometry_that_knows_better():
    """Both are off by 5 cm, and say so: the loops add to what is known, and would take from it if they always won."""
    errors = np.array([flown(seed, 0.003, 0.0002, 0.003, 0.0002, (0.05, 0.005)) for seed in range(12)])
    assert errors[:, 1].mean() < 0.9 * errors[:, 0].mean()


def test_an_odometry_that_claims_too_much_is_corrected_by_what_loops_show():
    """It drifts twenty times as fast as it says; taken at its word it would be off by half as much again."""
    errors = np.array([flown(seed, 0.06, 0.004, 0.003, 0.0002, (0.02, 0.003)) for seed in range(12)])
    assert errors[:, 1].mean() < 0.3 * errors[:, 0].mean()


def test_a_segment_after_a_reset_is_hardly_tied_to_the_one_before():
    t_ns, p, _ = circle(laps=1)
    segment = (np.arange(len(p)) >= 20).astype(int)
    graph = Odometry.of(t_ns, p, segment, OPTIONS)
    tied, across = graph.cov(np.array([0, 19]), np.array([19, 20]))
    assert np.sqrt(across[0, 0]) > 2.0 > 4.0 * np.sqrt(tied[0, 0])
    assert np.sqrt(across[3, 3]) >= 1.0
    np.testing.assert_array_equal(graph.as_told().cov(np.array([19]), np.array([20]))[0], across)


def test_loops_bring_a_lost_segment_home():
    """After a reset the second lap lies 4 m off and turned by half a radian; three loops put it right."""
    t_ns, p, _ = circle(laps=2)
    R, shift, turned = rotation_z(0.5), np.array([4.0, -1.0, 0.3]), 0.5
    odometry, segment = p.copy(), (np.arange(len(p)) >= 40).astype(int)
    odometry[40:] = p[40:] @ R.T + shift
    yaw_error = turned * segment
    loops = true_loops(p, yaw_error, [(2, 42), (10, 50), (30, 70)])
    graph = Odometry.of(t_ns, odometry, segment, OPTIONS)
    q, yaw, used = solve_robustly(odometry, graph.edges(), loops, every(loops))
    assert used.all()
    np.testing.assert_allclose(q, p, atol=0.02)
    np.testing.assert_allclose(yaw, -yaw_error, atol=0.01)


def frames_between(keys_t_ns, keys_p, per_key=10):
    t_ns = np.concatenate([np.linspace(a, b, per_key, endpoint=False) for a, b in pairwise(keys_t_ns)])
    t_ns = t_ns.astype(np.int64)
    p = np.column_stack([np.interp(t_ns, keys_t_ns, keys_p[:, k]) for k in range(3)])
    return t_ns, p


def test_frames_move_with_their_keyframes_and_smoothly():
    key_t_ns, key_p, angle = circle(laps=1)
    t_ns, p = frames_between(key_t_ns, key_p)
    R = np.array([rotation_z(a) for a in np.interp(t_ns, key_t_ns, angle)])
    rng = np.random.default_rng(5)
    yaw = np.cumsum(rng.normal(0.0, 0.01, len(key_p)))
    moved = key_p + np.cumsum(rng.normal(0.0, 0.02, key_p.shape), axis=0)
    zeros = np.zeros(len(t_ns), int)
    R_new, p_new = carry((t_ns, zeros, R, p), (key_t_ns, np.zeros(len(key_p), int), key_p), moved, yaw)
    at_keys = np.isin(t_ns, key_t_ns)
    np.testing.assert_allclose(p_new[at_keys], moved[:-1], atol=1e-9)
    np.testing.assert_allclose(R_new[at_keys], np.array([rotation_z(a) for a in yaw[:-1]]) @ R[at_keys], atol=1e-9)
    # No step of the corrected path differs from the odometry's by more than the correction moves from frame to frame.
    change = np.abs(np.diff(p_new, axis=0)) - np.abs(np.diff(p, axis=0))
    assert np.abs(change).max() < 0.03


def test_a_rigid_correction_moves_every_frame_rigidly():
    key_t_ns, key_p, angle = circle(laps=1)
    t_ns, p = frames_between(key_t_ns, key_p)
    R = np.array([rotation_z(a) for a in np.interp(t_ns, key_t_ns, angle)])
    G, shift = rotation_z(0.8), np.array([1.0, 2.0, 3.0])
    zeros, key_zeros = np.zeros(len(t_ns), int), np.zeros(len(key_p), int)
    R_new, p_new = carry(
        (t_ns, zeros, R, p), (key_t_ns, key_zeros, key_p), key_p @ G.T + shift, np.full(len(key_p), 0.8)
    )
    np.testing.assert_allclose(p_new, p @ G.T + shift, atol=1e-12)
    np.testing.assert_allclose(R_new, G @ R, atol=1e-12)


def test_frames_go_with_the_keyframes_of_their_own_segment():
    key_t_ns = np.array([0, 10, 20, 30]) * 10**8
    key_p, segment = np.zeros((4, 3)), np.array([0, 0, 1, 1])
    moved = np.array([[0.0, 0, 0], [0, 0, 0], [5, 0, 0], [5, 0, 0]])
    t_ns = np.array([5, 14, 16, 25, 35]) * 10**8
    frames = (t_ns, np.array([0, 0, 1, 1, 1]), np.repeat(np.eye(3)[None], 5, axis=0), np.zeros((5, 3)))
    _, p = carry(frames, (key_t_ns, segment, key_p), moved, np.zeros(4))
    assert p[:, 0].tolist() == [0.0, 0.0, 5.0, 5.0, 5.0]


def test_the_shorter_way_round_is_taken_where_yaw_wraps():
    key_t_ns, segment, key_p = np.array([0, 10]), np.zeros(2, int), np.zeros((2, 3))
    frames = (np.array([5]), np.zeros(1, int), np.eye(3)[None], np.zeros((1, 3)))
    R, _ = carry(frames, (key_t_ns, segment, key_p), key_p, np.array([np.pi - 0.1, -np.pi + 0.1]))
    np.testing.assert_allclose(R[0], rotation_z(np.pi), atol=1e-12)
