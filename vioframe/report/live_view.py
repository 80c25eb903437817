"""A run in rerun while it is flown: tracks, path, landmarks, states and times on one time line.

What it shows and how to read it: ``docs/view.md``. It looks as :mod:`vioframe.report.view` shows finished runs.

estimator -> _Waiting -> _Scene (a thread) -> rerun, which has threads of its own for a window or file
"""

from __future__ import annotations

import logging
import os
import re
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Condition, Thread
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import needs
from vioframe.report.style import colour
from vioframe.report.view import (
    BIAS_ACCEL,
    BIAS_GYRO,
    IN_VIEW,
    LANDMARK,
    LINE,
    OF_STATE,
    SIGMAS,
    TIME,
    TRACK,
    VELOCITY,
    axes_view,
    ellipsoids_of,
    entity,
    faint,
    frustum,
    image_view,
    jpeg,
    line_style,
    open_sink,
    rgba_of,
    times,
    within_bounds,
)
from vioframe.types import (
    DBA,
    DBG,
    DP,
    NS_PER_S,
    Calibration,
    CameraOnBody,
    Estimate,
    Float,
    FrameSet,
    FrameTracks,
    Image,
    NavState,
    Status,
    Step,
)

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

Colours = NDArray[np.uint32]
"""(N,) as 0xRRGGBBAA."""

_log = logging.getLogger("vioframe.view")

# Pictures are nearly all that a viewer has to keep: of each camera ten a second are shown, of less than full quality.
_PICTURE_NS, _JPEG_QUALITY = NS_PER_S // 10, 70
# What the window keeps, an hour of one camera of 752 x 480 px; then it forgets what is oldest.
_MEMORY_LIMIT = "2GB"
# Frames come that much early and late.
_JITTER_NS = NS_PER_S // 200
# What moves in the world is drawn so often, but for the body, which is moved with every frame.
_DRAWING_NS = NS_PER_S // 10
# Plots are sent so often, in columns: a message a row would take several times as long.
_PLOT_NS = NS_PER_S
# The path, and the landmarks that went out of sight, grow by a piece so often.
_PIECE_NS = NS_PER_S
# So many frames may wait to be shown, and so many of them with pictures.
_MOST_FRAMES, _MOST_PICTURED = 500, 4
# Within this, s, a viewer that answers has taken all that waits in the end.
_ENDS_WITHIN_S = 10.0
# The colours of tracks, from one that is new to one of so many frames or more, and steps on a scale of logarithms.
_BLUE, _ORANGE = rgba_of(colour(0)), rgba_of(colour(1))
_AGES, _OLD = ("#ffffff", "#f0e442", "#e69f00", "#d55e00"), 100
# The tail of a track shows where it was in the last so many pictures.
_TAIL, _TAIL_WIDTH = 4, -0.75
# A plot shows the last so many seconds.
_PLOTTED_S = 20.0
_SIGMA = "sigma_position"
_NUMBER = re.compile(r"\d+(\.\d+)?")
# Where the world is seen from at first, as seen from the body; the view goes with it.
_EYE_M = (-2.5, -2.5, 1.75)


class LiveView:
    """Shows the steps of a run called ``name`` as they come, in a window or in the file ``save`` (.rrd).

    A context manager. :meth:`add` takes microseconds: what is to be shown waits for a thread, and where that does not
    keep up the oldest picture that waits is left out, so that no flight waits for a viewer. Nothing that is held grows
    with the flight, and a window may be closed while flying. Raises :class:`VioframeError`
    where rerun, its viewer or a display is missing, or ``save`` cannot be written.
    """

    def __init__(self, name: str, calibration: Calibration, save: Path | None = None) -> None:
        # As the index of a file is left out, which rerun warns of.
        os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
        with needs("rerun", "view", user="--view"):
            import rerun as rr
        # Not the name that finished runs are shown by: an open window would show this in their layout.
        stream = rr.RecordingStream("vioframe live", send_properties=False)
        open_sink(stream, save, _blueprint(name, calibration.cameras), "--save-view", _MEMORY_LIMIT, index=False)
        self._waiting = _Waiting()
        self._pictures = [_Every(_PICTURE_NS) for _ in calibration.cameras]
        plots = _Plots(stream, name)
        self._thread = Thread(target=self._show, args=(stream, name, calibration, plots), name="view", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import rerun as rr

        self._waiting.end()
        self._thread.join(_ENDS_WITHIN_S)
        if self._thread.is_alive():
            rr.unregister_shutdown()  # which would wait for the viewer as well, for good
            _log.warning("the viewer takes nothing any more; the end of the flight is not shown")
        elif self.left_out:
            _log.warning("%d pictures were not shown, as the viewer could not keep up", self.left_out)

    @property
    def left_out(self) -> int:
        """How many frames were shown without their pictures."""
        return self._waiting.left_out

    def add(self, step: Step, latency_ms: float | None = None, dropped: int = 0) -> None:
        """Show a step, as soon as may be.

        Of a live source ``latency_ms`` is the time from the exposure to the estimate, and ``dropped`` the number of
        frames by now that gave way to newer ones.
        """
        t_ns, images = step.frames.t_ns, enumerate(step.frames.images)
        due = {place: image for place, image in images if image is not None and self._pictures[place].due(t_ns)}
        bare = replace(step, frames=FrameSet(t_ns, ()))  # no image waits that is not shown
        self._waiting.put(_Frame(bare, due, latency_ms, dropped))

    def _show(self, stream: rr.RecordingStream, name: str, calibration: Calibration, plots: _Plots) -> None:
        """The thread."""
        try:
            scene = _Scene(stream, name, calibration, plots)
            for frame in self._waiting:
                scene.show(frame)
            scene.finish()
            with suppress(RuntimeError):  # from a window that was closed
                stream.flush()
            stream.disconnect()
        except Exception as error:  # a flight does not end because it can no longer be watched
            _log.warning("the flight is no longer shown: %s", error)
            self._waiting.end()
            for _ in self._waiting:
                pass


class _Every:
    """Tells of a sequence of stamps those that are ``period_ns`` apart, the first of them being one."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns - _JITTER_NS
        self._last_ns: int | None = None

    def due(self, t_ns: int) -> bool:
        due = self._last_ns is None or t_ns - self._last_ns >= self._period_ns
        if due:
            self._last_ns = t_ns
        return due


@dataclass(slots=True)
class _Frame:
    """A step, with the images that are to be shown of it by the place of their camera, and how late it is."""

    step: Step
    pictures: dict[int, Image]
    latency_ms: float | None
    dropped: int


class _Waiting:
    """Frames from one thread for another, in order; where too many wait, the oldest give way, their pictures first."""

    def __init__(self) -> None:
        self._frames: deque[_Frame] = deque()
        self._pictured: deque[_Frame] = deque()
        self._changed = Condition()
        self._ended = False
        self.left_out = 0

    def put(self, frame: _Frame) -> None:
        with self._changed:
            if self._ended:
                return
            if frame.pictures:
                if len(self._pictured) == _MOST_PICTURED:
                    self._pictured.popleft().pictures.clear()
                    self.left_out += 1
                self._pictured.append(frame)
            if len(self._frames) == _MOST_FRAMES:
                self._take()
            self._frames.append(frame)
            self._changed.notify()

    def end(self) -> None:
        """Nothing more comes: what waits is still given out."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def __iter__(self) -> Iterator[_Frame]:
        while True:
            with self._changed:
                while not self._frames:
                    if self._ended:
                        return
                    self._changed.wait()
                frame = self._take()
            yield frame

    def _take(self) -> _Frame:
        frame = self._frames.popleft()
        if self._pictured and self._pictured[0] is frame:
            self._pictured.popleft()
        return frame


class _Scene:
    """What a recording of rerun is told of the frames, one after the other."""

    def __init__(self, stream: rr.RecordingStream, name: str, calibration: Calibration, plots: _Plots) -> None:
        import rerun as rr

        self._stream, self._name, self._cameras = stream, name, calibration.cameras
        self._plots = plots
        self._drawings, self._pieces = _Every(_DRAWING_NS), _Every(_PIECE_NS)
        self._begin_ns: int | None = None
        self._state: NavState | None = None
        self._undrawn = False
        self._status: Status | None = None
        self._events: tuple[str, ...] = ()
        self._dropped = 0
        self._ages: list[dict[int, int]] = [{} for _ in calibration.cameras]
        self._tails: list[dict[int, list[list[float]]]] = [{} for _ in calibration.cameras]
        self._landmarks: dict[int, list[float]] = {}
        self._in_view: set[int] = set()
        self._paths: dict[str, list[Float]] = {}
        # There is one time line.
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log(self._in_world("3 sigma"), rr.Ellipsoids3D.from_fields(colors=_BLUE), static=True)

    def show(self, frame: _Frame) -> None:
        """Tell of a frame, which is later than all before."""
        step, t_ns, estimate = frame.step, frame.step.frames.t_ns, frame.step.estimate
        if self._begin_ns is None:
            self._begin_ns = self._plots.begin_ns = t_ns
        self._stream.set_time(TIME, duration=np.timedelta64(t_ns - self._begin_ns, "ns"))
        whole, drawn = self._pieces.due(t_ns), self._drawings.due(t_ns)
        if whole:
            learned = estimate.calibration
            self._show_cameras(self._cameras if learned is None else learned.calibration.cameras)
        self._show_status(estimate, frame.dropped if whole else self._dropped)
        self._show_tracks(step.tracks, frame.pictures)
        state = estimate.state if estimate.status is Status.TRACKING else None
        if state is not None:
            self._follow(step, state)
            if whole:
                self._append_pieces()
            self._undrawn = not (drawn or whole)
            if not self._undrawn:
                self._draw(state)
        elif self._state is not None:
            self._end_stretch()
        if state is not None or self._state is not None:
            self._plots.add_state(t_ns, state)
        self._state = state
        new = sum(age == 0 for ages in self._ages for age in ages.values())
        self._plots.add_work(step, frame.latency_ms, new)
        self._plots.send_due(t_ns)

    def finish(self) -> None:
        """Tell what waits to be told with more of its kind."""
        if self._state is not None and self._undrawn:
            self._draw(self._state)
        self._plots.send()

    def _in_world(self, *parts: str) -> str:
        return entity("world", self._name, *parts)

    def _show_cameras(self, cameras: Iterable[CameraOnBody]) -> None:
        for camera in cameras:
            if camera.rotation_known:
                for part in frustum(camera, _BLUE):
                    self._stream.log(self._in_world("body", camera.name), part)

    def _show_status(self, estimate: Estimate, dropped: int) -> None:
        """What the back-end says or, where that is nothing new, how it is now; and how many frames were dropped."""
        import rerun as rr

        # Why a start is refused is said frame by frame, with numbers of the day.
        events = tuple(_NUMBER.sub("#", event) for event in estimate.events)
        said = [*estimate.events] if events != self._events else []
        if not said and estimate.status is not self._status:
            said = [estimate.status]
        level = rr.TextLogLevel.WARN if estimate.status is Status.LOST else rr.TextLogLevel.INFO
        lines = [(text, level) for text in said]
        if dropped > self._dropped:
            lines.append((f"frames dropped: {dropped - self._dropped}, {dropped} by now", rr.TextLogLevel.WARN))
        for text, level in lines:
            self._stream.log(entity("status", self._name), rr.TextLog(text, level=level))
        self._status, self._events, self._dropped = estimate.status, events or self._events, dropped

    def _show_tracks(self, tracks: FrameTracks, pictures: Mapping[int, Image]) -> None:
        """In the pictures, each with a tail of where it was in those before; ages count all frames."""
        import rerun as rr

        for place, before in enumerate(self._ages):
            own = tracks.of_camera(place)
            if len(own.ids):
                self._ages[place] = {i: before.get(i, -1) + 1 for i in own.ids.tolist()}
        for place, image in pictures.items():
            own, ages, were = tracks.of_camera(place), self._ages[place], self._tails[place]
            ids, at = own.ids.tolist(), entity(_body(self._name), self._cameras[place].name)
            tails = {i: [*were.get(i, ())[1 - _TAIL :], xy] for i, xy in zip(ids, own.xy.tolist(), strict=True)}
            self._tails[place] = tails
            rgba = _age_colours([ages[i] for i in ids])
            strips = np.array([[xy[0]] * (_TAIL - len(xy)) + xy for xy in tails.values()]).reshape(-1, _TAIL, 2)
            self._stream.log(f"{at}/image", jpeg(image, _JPEG_QUALITY))
            self._stream.log(f"{at}/tracks", rr.Points2D(own.xy, colors=rgba, radii=TRACK))
            self._stream.log(f"{at}/tracks/tails", rr.LineStrips2D(strips, colors=rgba, radii=_TAIL_WIDTH))

    def _follow(self, step: Step, state: NavState) -> None:
        """Where the body is, and what its path and the landmarks are by it."""
        import rerun as rr

        self._stream.log(_body(self._name), rr.Transform3D(translation=state.p_WB, mat3x3=state.R_WB))
        self._paths.setdefault(self._name, []).append(state.p_WB)
        loops = step.correction
        # Until one is believed its path would hide the other.
        if loops is not None and (loops.p_MW.any() or not np.array_equal(loops.R_MW, np.eye(3))):
            self._paths.setdefault(_closed(self._name), []).append(loops.R_MW @ state.p_WB + loops.p_MW)
        self._landmarks.update(zip(step.estimate.landmark_ids.tolist(), step.estimate.p_WF.tolist(), strict=True))
        self._in_view = set(step.tracks.ids.tolist())

    def _draw(self, state: NavState) -> None:
        """How sure the position is, the landmarks in view as they are by now, and the path since its last piece."""
        import rerun as rr

        if state.cov is not None:
            half_sizes, quaternions = ellipsoids_of(state.cov[None, DP, DP])
            ellipsoid = rr.Ellipsoids3D.from_fields(
                centers=[state.p_WB], half_sizes=half_sizes, quaternions=quaternions
            )
            self._stream.log(self._in_world("3 sigma"), ellipsoid)
        ids = [i for i in self._landmarks if i in self._in_view]
        oldest = [max(ages.get(i, 0) for ages in self._ages) for i in ids]
        self._log_points("landmarks in view", [self._landmarks[i] for i in ids], _age_colours(oldest), IN_VIEW)
        for name, points in self._paths.items():
            self._log_strip(name, "newest path", points)

    def _append_pieces(self) -> None:
        """The path since the last piece, and the landmarks that went out of view, as they were last."""
        for name, points in self._paths.items():
            self._log_strip(name, "path", points)
            del points[:-1]
        gone = [p_WF for i, p_WF in self._landmarks.items() if i not in self._in_view]
        self._log_points("landmarks", gone, faint(_BLUE), LANDMARK)
        self._landmarks = {i: p_WF for i, p_WF in self._landmarks.items() if i in self._in_view}

    def _end_stretch(self) -> None:
        """Nothing is in view of who is lost, and no line leads to where it begins anew."""
        self._in_view = set()
        self._append_pieces()
        self._log_points("landmarks in view", [], _age_colours([]), IN_VIEW)
        for name, points in self._paths.items():
            points.clear()
            self._log_strip(name, "newest path", points)

    def _log_strip(self, name: str, part: str, points: list[Float]) -> None:
        import rerun as rr

        rgba = _BLUE if name == self._name else faint(_BLUE)
        strips = rr.LineStrips3D([points] if len(points) > 1 else [], colors=rgba, radii=LINE)
        self._stream.log(entity("world", name, part), strips)

    def _log_points(self, part: str, p_WF: list[list[float]], rgba: int | Colours, radius: float) -> None:
        import rerun as rr

        points = rr.Points3D(np.array(p_WF).reshape(-1, 3), colors=rgba, radii=radius)
        self._stream.log(self._in_world(part), points)


class _Plots:
    """Rows of plots, which are sent in columns, a second of each at once."""

    def __init__(self, stream: rr.RecordingStream, name: str) -> None:
        self._stream, self._name = stream, name
        self.begin_ns = 0
        self._sendings = _Every(_PLOT_NS)
        self._rows: dict[str, list[tuple[int, list[float]]]] = {}
        self._stages: dict[str, int] = {}

    def add_state(self, t_ns: int, state: NavState | None) -> None:
        """Velocity, biases within their bounds, and how sure the position is; without a state a gap."""
        sigma = np.full(15, np.nan) if state is None or state.cov is None else np.sqrt(np.diagonal(state.cov))
        velocity = gyro = accel = np.full(3, np.nan)
        if state is not None:
            velocity, gyro, accel = state.v_WB, state.bias_gyro_B, state.bias_accel_B
        lines_by_name = {
            VELOCITY: velocity[:, None],
            BIAS_GYRO: within_bounds(gyro[None], sigma[None, DBG])[0],
            BIAS_ACCEL: within_bounds(accel[None], sigma[None, DBA])[0],
            _SIGMA: SIGMAS * sigma[DP, None],
        }
        for name, lines in lines_by_name.items():
            for axis, values in zip("xyz", lines.tolist(), strict=True):
                self._add(t_ns, entity(name, axis, self._name), axis, _BLUE, values)

    def add_work(self, step: Step, latency_ms: float | None, new: int) -> None:
        """Milliseconds by stage and in all, and from the exposure on; points followed, and new among them."""
        t_ns, name = step.frames.t_ns, self._name
        # Their parts are for later, to be seen in the finished run.
        spent = {stage: 1e3 * seconds for stage, seconds in step.stage_seconds.items() if "." not in stage}
        for stage in spent:
            self._stages.setdefault(stage, len(self._stages))
        for stage, number in self._stages.items():
            self._add(t_ns, entity("stages", name, stage), stage, rgba_of(colour(number)), [spent.get(stage, 0.0)])
        self._add(t_ns, entity("time", name), "in all", _BLUE, [sum(spent.values())])
        if latency_ms is not None:
            self._add(t_ns, entity("latency", name), "from exposure to estimate", _ORANGE, [latency_ms])
        self._add(t_ns, entity("features", name, "tracked"), "tracked", _BLUE, [len(step.tracks.ids)])
        self._add(t_ns, entity("features", name, "new"), "new", _ORANGE, [new])

    def send_due(self, t_ns: int) -> None:
        """Send what there is by now where that is due."""
        if self._sendings.due(t_ns):
            self.send()

    def send(self) -> None:
        import rerun as rr

        for path, rows in self._rows.items():
            if rows:
                stamps, values = zip(*rows, strict=True)
                columns = rr.Scalars.columns(scalars=np.concatenate(values)).partition([len(each) for each in values])
                self._stream.send_columns(path, [times(np.array(stamps), self.begin_ns)], columns)
                rows.clear()

    def _add(self, t_ns: int, path: str, label: str, rgba: int, values: list[float]) -> None:
        if path not in self._rows:
            self._rows[path] = []
            self._stream.log(path, line_style(label, rgba, len(values)), static=True)
        self._rows[path].append((t_ns, values))


def _scale() -> Colours:
    """(_OLD + 1,) by age."""
    stops = np.array([list(bytes.fromhex(each[1:])) for each in _AGES])
    at = np.log1p(np.arange(_OLD + 1)) / np.log1p(_OLD) * (len(stops) - 1)
    red, green, blue = (np.interp(at, np.arange(len(stops)), part).round().astype(np.int64) for part in stops.T)
    return np.array(red << 24 | green << 16 | blue << 8 | 0xFF, np.uint32)


_SCALE = _scale()


def _age_colours(ages: Sequence[int]) -> Colours:
    """(N,) of tracks of these ages, in frames."""
    return _SCALE[np.minimum(np.array(ages, np.int64), _OLD)]


def _body(name: str) -> str:
    return entity("world", name, "body")


def _closed(name: str) -> str:
    """What loop closure makes of a run, called as among finished runs."""
    return f"{name} with loop closure"


def _blueprint(name: str, cameras: Sequence[CameraOnBody]) -> rrb.Blueprint:
    """The world at the left, above what is said; at the right the images and, in tabs, what goes with the time."""
    import rerun.blueprint as rrb

    boundary = rrb.TimeRangeBoundary
    eyes = [entity(_body(name), camera.name) for camera in cameras]
    ever = rrb.VisibleTimeRanges(timeline=TIME, start=boundary.infinite(), end=boundary.cursor_relative())
    grown = [entity("world", name, "path"), entity("world", name, "landmarks"), entity("world", _closed(name), "path")]
    world = rrb.Spatial3DView(
        origin="world",
        name="world",
        contents=["$origin/**", *(f"- {camera}/tracks/**" for camera in eyes)],
        overrides=dict.fromkeys(grown, ever),
        eye_controls=rrb.EyeControls3D(
            position=_EYE_M, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0), tracking_entity=_body(name)
        ),
    )
    said = rrb.TextLogView(
        origin="status",
        name="status",
        columns=rrb.TextLogColumns(timeline_columns=[TIME], text_log_columns=["LogLevel", "Body"]),
    )
    lately = rrb.TimeAxis(
        view_range=rrb.TimeRange(boundary.cursor_relative(seconds=-_PLOTTED_S), boundary.cursor_relative())
    )
    work = [
        rrb.TimeSeriesView(origin="/", contents=["/time/**", "/latency/**"], name="time a frame [ms]", axis_x=lately),
        rrb.TimeSeriesView(origin="stages", name="by stage [ms]", axis_x=lately),
        rrb.TimeSeriesView(origin="features", name="features", axis_x=lately),
    ]
    titles = {**OF_STATE, _SIGMA: "3σ of the position [m]"}
    velocity, *states = (axes_view(each, title, axis_x=lately) for each, title in titles.items())
    beside = rrb.Vertical(
        rrb.Grid(*map(image_view, eyes), grid_columns=min(len(eyes), 2)),
        rrb.Tabs(velocity, rrb.Vertical(*work, name="work"), *states),
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(world, said, row_shares=[4, 1]), beside, column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        collapse_panels=True,
    )
