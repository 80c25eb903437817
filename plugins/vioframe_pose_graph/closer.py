"""The loop closer as a recipe: pick keyframes, recognise places in a thread of its own, correct there and at the end.

Qin, Li, Shen, "VINS-Mono" (T-RO 2018), sections VII and VIII, with other means of retrieval and verification.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from vioframe.frontend import anchors
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.geometry.trajectory import Trajectory
from vioframe.stopwatch import working_s
from vioframe.types import NS_PER_S, Calibration, Float, Int, Loop, LoopClosure, MapCorrection, Status, Step
from vioframe_pose_graph.consistency import REPEAT_NS, Odometry, agreed, corrected, measured, within_drift
from vioframe_pose_graph.corners import triangulated
from vioframe_pose_graph.graph import wrapped
from vioframe_pose_graph.keyframes import Keyframe, KeyframeSelector
from vioframe_pose_graph.matching import DescriptorIndex, match
from vioframe_pose_graph.options import PoseGraphOptions
from vioframe_pose_graph.place import Place
from vioframe_pose_graph.recognition import Recogniser, Sighting
from vioframe_pose_graph.verification import supported

# What a keyframe tells counts from so much later on by the stamps: by then the thread is through with it.
_LATENCY_NS = NS_PER_S
# The graph of a flight under way is solved no more often than this, and of so many loops at most.
_SOLVE_EVERY_NS = NS_PER_S
_MOST_LOOPS = 100


class PoseGraph:
    """Recognition sees the keyframes in their order whatever the clock says, so the result is the same every time.

    So is the correction so far: it is due by the stamps, and waited for where the thread has fallen behind them.
    """

    def __init__(self, calibration: Calibration, options: PoseGraphOptions | None = None) -> None:
        self._options = options or PoseGraphOptions()
        self._selector = KeyframeSelector(calibration, self._options.parallax_px)
        self._recogniser = Recogniser(calibration.cameras[0].model.focal_px, self._options)
        self._worker = ThreadPoolExecutor(1, "loop-closure")
        self._waiting: deque[tuple[int, Future[MapCorrection]]] = deque()
        self._correction = MapCorrection()
        # The thread's own: what it has solved, for how many sightings and until when, and how long it took.
        self._newest, self._weighed, self._solved_ns, self._solving_s = self._correction, 0, 0, 0.0
        self._sound = np.empty(0, np.int64)
        # Of every tracked frame: an hour of them takes 10 MB like this.
        self._t_ns, self._segments = array("q"), array("q")
        self._R_WB, self._p_WB = array("d"), array("d")

    def add(self, step: Step) -> MapCorrection:
        """Take in a frame; the correction by the loops found until a second before. Raises what finding them raised."""
        t_ns = step.frames.t_ns
        self._submit(self._selector.add(step), t_ns + _LATENCY_NS)
        if step.estimate.status is Status.TRACKING and step.estimate.state is not None:
            state = step.estimate.state
            self._t_ns.append(state.t_ns)
            self._segments.append(self._selector.segment)
            self._R_WB.extend(state.R_WB.ravel())
            self._p_WB.extend(state.p_WB)
        while self._waiting and self._waiting[0][0] <= t_ns:
            self._correction = self._waiting.popleft()[1].result()
        return self._correction

    def finish(self) -> LoopClosure:
        """Wait for recognition, believe what is consistent, and correct every frame."""
        self._submit(self._selector.flush(), 0)
        while self._waiting:
            self._waiting.popleft()[1].result()
        self._worker.shutdown()
        if not self._t_ns:
            return LoopClosure(None, np.empty(0, np.int64), (), self._recogniser.seconds)
        return self._close()

    def _submit(self, keyframes: list[Keyframe], due_ns: int) -> None:
        self._waiting.extend((due_ns, self._worker.submit(self._recognise, keyframe)) for keyframe in keyframes)

    def _recognise(self, keyframe: Keyframe) -> MapCorrection:
        """In the thread: look for the place of ``keyframe``; the correction by the loops of it and those before."""
        self._recogniser.add(keyframe)
        t_ns, sightings = keyframe.state.t_ns, len(self._recogniser.sightings)
        if sightings > self._weighed and t_ns - self._solved_ns >= _SOLVE_EVERY_NS:
            begin = working_s()
            self._newest, self._weighed, self._solved_ns = self._corrected_newest(), sightings, t_ns
            self._solving_s += working_s() - begin
        return self._newest

    def _corrected_newest(self) -> MapCorrection:
        """How the newest keyframe moves in a graph of those that the loops so far, or some of them, tie together."""
        t_ns, _, odometry = self._keyframes()
        sightings = self._recogniser.sightings
        # Whether others agree with a sighting is settled after a while, and not asked again.
        asked, open_ = (
            bisect_left(sightings, self._solved_ns - ago_ns, key=lambda s: t_ns[s.later])
            for ago_ns in (2 * REPEAT_NS, REPEAT_NS)
        )
        sound = asked + np.flatnonzero(agreed(measured(sightings[asked:]), odometry, t_ns))
        self._sound = np.concatenate([self._sound[self._sound < open_], sound[sound >= open_]])
        spread = np.linspace(0, len(self._sound) - 1, min(len(self._sound), _MOST_LOOPS)).astype(int)
        loops = measured([sightings[k] for k in self._sound[spread].tolist()])
        likely = within_drift(loops, odometry)
        nodes = np.concatenate([[0], loops.i, loops.j, [len(t_ns) - 1]])
        nodes, number = np.unique(nodes, return_inverse=True)
        i, j = number[1:-1].reshape(2, -1)
        few = odometry.at(nodes)
        p, yaw, _ = corrected(few, replace(loops, i=i, j=j), likely)
        R_MW = rotation_z(yaw[-1])
        return MapCorrection(R_MW, p[-1] - R_MW @ few.p[-1])

    def _keyframes(self) -> tuple[Int, Int, Odometry]:
        """The stamps and segments of all keyframes, and where the odometry placed them."""
        places = self._recogniser.places
        t_ns = np.array([place.t_ns for place in places])
        segment = np.array([place.segment for place in places])
        p, cov = np.array([place.p_WB for place in places]), np.array([place.cov for place in places])
        return t_ns, segment, Odometry.of(t_ns, p, segment, self._options, cov)

    def _close(self) -> LoopClosure:
        begin = working_s()
        places, sightings = self._recogniser.places, self._recogniser.sightings
        t_ns, segment, odometry = self._keyframes()
        said = measured(sightings)
        sound, likely = agreed(said, odometry, t_ns), within_drift(said, odometry)
        accepted = np.zeros(len(sightings), bool)
        p, yaw, accepted[sound] = corrected(odometry, said.select(sound), likely[sound])
        trajectory = self._carried(t_ns, segment, odometry.p, p, yaw)
        loops = tuple(_loop(s, places, good) for s, good in zip(sightings, accepted.tolist(), strict=True))
        seconds = {"solve_so_far": self._solving_s, "solve": working_s() - begin}
        return LoopClosure(trajectory, t_ns, loops, {**self._recogniser.seconds, **seconds})

    def _carried(self, t_ns: Int, segment: Int, key_p: Float, p: Float, yaw: Float) -> Trajectory:
        stamps = np.array(self._t_ns, np.int64)
        frames = (
            stamps,
            np.array(self._segments, np.int64),
            np.array(self._R_WB).reshape(-1, 3, 3),
            np.array(self._p_WB).reshape(-1, 3),
        )
        return Trajectory(stamps, *carry(frames, (t_ns, segment, key_p), p, yaw))


def _loop(sighting: Sighting, places: Sequence[Place], accepted: bool) -> Loop:
    """The sighting as it leaves the plug-in: the later body seen from the earlier one, levelled."""
    earlier, later, relation = places[sighting.earlier], places[sighting.later], sighting.relation
    heading = float(yaw_of(earlier.R_WB))
    p_L = rotation_z(heading).T @ relation.z
    yaw = float(wrapped(yaw_of(later.R_WB) + relation.yaw - heading))
    return Loop(earlier.t_ns, later.t_ns, p_L, yaw, relation.inliers, accepted)


def carry(
    frames: tuple[Int, Int, Float, Float], keys: tuple[Int, Int, Float], p_corrected: Float, yaw: Float
) -> tuple[Float, Float]:
    """R_WB (F, 3, 3) and p_WB (F, 3) of all frames, moved along with the keyframes of their segment.

    ``frames`` are the stamps, segments, attitudes and positions of all frames by the odometry, ``keys`` the stamps,
    segments and positions of the keyframes; ``p_corrected`` (N, 3) and ``yaw`` (N,) are what the graph made of those. A
    frame between two keyframes is where each of them would carry it, weighted by the time to the other, so that the
    corrected path is as continuous as the odometry's own.
    """
    t_ns, segment, R_WB, p_WB = frames
    key_t_ns, key_segment, key_p = keys
    left, right, fraction = _between(t_ns, segment, key_t_ns, key_segment)
    turn = wrapped(yaw[right] - yaw[left])

    def carried(by: Int) -> Float:
        moved = np.einsum("fij,fj->fi", rotation_z(yaw[by]), p_WB - key_p[by])
        return np.asarray(p_corrected[by] + moved)

    p = (1.0 - fraction)[:, None] * carried(left) + fraction[:, None] * carried(right)
    return rotation_z(yaw[left] + fraction * turn) @ R_WB, p


def _between(t_ns: Int, segment: Int, key_t_ns: Int, key_segment: Int) -> tuple[Int, Int, Float]:
    """(F,) the keyframes before and after each frame in its own segment, and how far it is from one to the other."""
    first = np.searchsorted(key_segment, segment, side="left")
    last = np.searchsorted(key_segment, segment, side="right") - 1
    left = np.clip(np.searchsorted(key_t_ns, t_ns, side="right") - 1, first, last)
    right = np.clip(left + 1, first, last)
    span = np.maximum(key_t_ns[right] - key_t_ns[left], 1)
    return left, right, np.clip((t_ns - key_t_ns[left]) / span, 0.0, 1.0)


def warm_up() -> None:
    """Call every kernel once with the types that it will be called with."""
    descriptors = np.zeros((2, 4), np.uint64)
    index = DescriptorIndex()
    index.add(descriptors, 0)
    index.similarity(descriptors, 1)
    match(descriptors, descriptors, np.zeros((2, 2)), 1, 1.0, 1.0)
    poses = np.stack([np.eye(3)] * 2), np.eye(2, 3)
    triangulated(*poses, np.zeros((1, 2, 2)), 1.0)
    anchors.warm_up()
    supported(np.zeros(1), np.zeros((1, 3)), np.ones((1, 3)), np.zeros((1, 2)), np.zeros(1, np.int64), *poses, 1.0)
