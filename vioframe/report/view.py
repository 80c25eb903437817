"""Runs as a rerun recording: paths, cameras, images with tracks, landmarks, errors and times on one time line.

What it shows and how to read it: ``docs/view.md``. Runs are told apart by their colours, as in the plots.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.errors import RunError, VioframeError, needs
from vioframe.geometry import so3
from vioframe.geometry.meshes import read_mesh
from vioframe.report.style import TRUTH_COLOUR, looks
from vioframe.runs.evaluated import Evaluated
from vioframe.runs.folder import RunFolder
from vioframe.types import DBA, DBG, DP, DTHETA, NS_PER_S, CameraOnBody, Float, FrameSet, Image, Int

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from vioframe.parts.registry import Registry

# What is public here is what the view of a run that is being flown (live_view.py) looks the same by.
TIME = "time"
SIGMAS = 3.0
_JPEG_QUALITY = 80
_FRUSTUM_M = 0.25
# The world is seen through, as it would hide what flies in it.
_GLASS = (120, 130, 150, 24)
# In points of the screen, which rerun tells from metres by their sign.
LINE, _TRUTH, LANDMARK, IN_VIEW, TRACK = -2.0, -1.0, -1.0, -2.5, 3.0
_POSITION, _ROTATION, VELOCITY, BIAS_GYRO, BIAS_ACCEL = "position", "rotation", "velocity", "bias_gyro", "bias_accel"
OF_STATE = {
    VELOCITY: "velocity [m/s]",
    BIAS_GYRO: "gyroscope bias [rad/s]",
    BIAS_ACCEL: "accelerometer bias [m/s²]",
}
_TITLES = {_POSITION: "position error [m]", _ROTATION: "rotation error [deg]", **OF_STATE}


def view_runs(
    runs: Sequence[Evaluated], installed: Registry, save: Path | None = None, *, world: Path | None = None
) -> None:
    """Open ``runs`` in rerun's viewer, or write the recording ``save`` (.rrd) instead.

    ``world`` is a mesh in the ground truth's world. Images are those of the recordings that the runs were made on, as
    far as they are still there and a reader of ``installed`` opens them. Raises :class:`VioframeError` where rerun, a
    display or a pose is missing.
    """
    with needs("rerun", "view", user="view"):
        import rerun as rr
    if all(run.estimate is None for run in runs):
        raise RunError("there is nothing to show: no pose was estimated; the events in summary.json say why")
    mesh = None if world is None else read_mesh(world)
    with rr.RecordingStream("vioframe", send_properties=False) as stream:
        shown = _shown(runs, stream)
        blueprint = _blueprint(shown)
        open_sink(stream, save, blueprint)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if mesh is not None:
            glass = rr.Mesh3D(vertex_positions=mesh.reshape(-1, 3).astype(np.float32), albedo_factor=_GLASS)
            stream.log("world/mesh", glass, static=True)
        for each in shown:
            each.log_all()
        _log_truths(shown)
        _log_images(shown, installed)


@dataclass(frozen=True)
class _Shown:
    """A run on its way into ``stream``: its colour and the stamp at which its time begins.

    ``images_at`` is the body that the images of its recording are shown on: that of the first run that was made on it.
    """

    stream: rr.RecordingStream
    run: Evaluated
    colour: int
    begin_ns: int
    images_at: str

    @property
    def faint(self) -> int:
        return faint(self.colour)

    def in_world(self, *parts: str) -> str:
        """The entity of this run that is called so."""
        return entity("world", self.run.name, *parts)

    def log(self, path: str, what: Any) -> None:
        """What holds all the time."""
        self.stream.log(path, what, static=True)

    def send(self, path: str, t_ns: Int, columns: Any) -> None:
        """What changes over time: a row a stamp."""
        self.stream.send_columns(path, [times(t_ns, self.begin_ns)], columns)

    def log_all(self) -> None:
        self._path_and_covariance()
        self._errors()
        if self.run.folder is not None:
            self._cameras_and_tracks(self.run.folder)
            self._landmarks(self.run.folder)
            self._states(self.run.folder)
            self._times(self.run.folder)

    def _path_and_covariance(self) -> None:
        import rerun as rr

        estimate = self.run.aligned
        if estimate is None:
            return
        strips = np.split(estimate.p_WB, self.run.breaks(estimate.t_ns))
        self.log(self.in_world("path"), rr.LineStrips3D(strips, radii=LINE, colors=self.colour))
        poses = rr.Transform3D.columns(translation=estimate.p_WB, quaternion=estimate.quat_xyzw)
        self.send(self.in_world("body"), estimate.t_ns, poses)
        if estimate.cov_pose is None:
            return
        known = np.isfinite(estimate.cov_pose).all(axis=(1, 2))
        half_sizes, quaternions = ellipsoids_of(estimate.cov_pose[known, DP, DP])
        ellipsoids = rr.Ellipsoids3D.columns(
            centers=estimate.p_WB[known], half_sizes=half_sizes, quaternions=quaternions
        )
        path = self.in_world("3 sigma")
        self.log(path, rr.Ellipsoids3D.from_fields(colors=self.colour))
        self.send(path, estimate.t_ns[known], ellipsoids)

    def _errors(self) -> None:
        """Errors within their bounds, each stretch between resets in the gauge of its own first pose: there the
        covariance that a filter states is meant. ``evaluate`` speaks of errors that are aligned over the whole path."""
        for errors in self.run.errors_by_stretch() if self.run.errors else ():
            cov = errors.estimate.cov_pose
            sigma = np.full((len(errors.estimate), 6), np.nan)
            if cov is not None:
                sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
            t_ns = errors.estimate.t_ns
            self._series(_POSITION, t_ns, errors.position_m, sigma[:, DP], centred=True)
            self._series(_ROTATION, t_ns, errors.rotation_rpy_deg, np.degrees(sigma[:, DTHETA]), centred=True)

    def _states(self, folder: RunFolder) -> None:
        states = folder.states()
        if states is not None:
            R_GW = self.run.errors.alignment.R_GW if self.run.errors else np.eye(3)
            self._series(VELOCITY, states.t_ns, states.v_WB @ R_GW.T)
            self._series(BIAS_GYRO, states.t_ns, states.bias_gyro_B, states.sigma[:, DBG])
            self._series(BIAS_ACCEL, states.t_ns, states.bias_accel_B, states.sigma[:, DBA])

    def _series(
        self, name: str, t_ns: Int, values: Float, sigma: Float | None = None, *, centred: bool = False
    ) -> None:
        """``values`` (N, 3) along x, y, z, with bounds around them or, if ``centred``, around zero."""
        import rerun as rr

        breaks = self.run.breaks(t_ns)
        # With a NaN at every break, so that no line is drawn where nothing was estimated.
        stamps = np.insert(t_ns, breaks, t_ns[breaks] - 1)
        lines = values[:, :, None]
        if sigma is not None and np.isfinite(sigma).any():
            lines = within_bounds(values, sigma, centred=centred)
        rows = np.insert(lines, breaks, np.nan, axis=0)
        for k, axis in enumerate("xyz"):
            path = entity(name, axis, self.run.name)
            self.log(path, line_style(f"{axis} {self.run.name}", self.colour, rows.shape[2]))
            columns = rr.Scalars.columns(scalars=rows[:, k].ravel()).partition([rows.shape[2]] * len(rows))
            self.send(path, stamps, columns)

    def _times(self, folder: RunFolder) -> None:
        """Milliseconds by stage and in all; features tracked, and new among them."""
        import rerun as rr

        timings, tracks = folder.timings(), folder.tracks()
        if timings is None:
            return
        name = self.run.name
        spent = {stage: 1e3 * seconds for stage, seconds in timings.exclusive().items()}
        series: dict[str, Float | Int] = {entity("stages", name, stage): each for stage, each in spent.items()}
        named = {entity("time", name): (name, np.sum(list(spent.values()), axis=0))}
        if tracks is not None:
            named |= {
                entity("features", name, "tracked"): (name, tracks.tracked),
                entity("features", name, "new"): (f"{name}, new", tracks.new),
            }
        for path, (label, values) in named.items():
            self.log(path, rr.SeriesLines(colors=self.colour, names=label))
            series[path] = values
        for path, values in series.items():
            self.send(path, timings.t_ns, rr.Scalars.columns(scalars=values.astype(np.float64)))

    def _cameras_and_tracks(self, folder: RunFolder) -> None:
        import rerun as rr

        calibration, tracks = folder.learned_calibration() or folder.calibration(), folder.tracks()
        for place, name in enumerate(_camera_names(folder)):
            if calibration is not None and calibration.cameras[place].rotation_known:
                for part in frustum(calibration.cameras[place], self.colour):
                    self.log(self.in_world("body", name), part)
            if tracks is not None:
                own = tracks.seen_by(place)
                rgba = np.where(own.is_new, 0xFFFFFFFF, self.colour).astype(np.uint32)
                points = rr.Points2D.columns(positions=own.xy, colors=rgba, radii=np.full(len(rgba), TRACK))
                path = entity(self.images_at, name, "tracks", self.run.name)
                self.send(path, own.frames_ns, points.partition(own.tracked))

    def _landmarks(self, folder: RunFolder) -> None:
        """The map without the landmarks that stand alone and, larger, those of them that a frame tracks."""
        import rerun as rr

        landmarks, tracks = self.run.landmarks(), folder.tracks()
        if landmarks is None:
            return
        path = self.in_world("landmarks")
        self.log(path, rr.Points3D(landmarks.p_WF, colors=self.faint, radii=LANDMARK))
        if tracks is None:
            return
        row = np.searchsorted(landmarks.ids, tracks.ids).clip(max=len(landmarks) - 1)
        known = np.flatnonzero(landmarks.ids[row] == tracks.ids)
        counts = np.array([np.count_nonzero(tracks.t_ns[known] == t) for t in tracks.frames_ns])
        large = self.in_world("landmarks in view")
        self.log(large, rr.Points3D.from_fields(colors=self.colour, radii=IN_VIEW))
        points = rr.Points3D.columns(positions=landmarks.p_WF[row[known]]).partition(counts)
        self.send(large, tracks.frames_ns, points)


def _shown(runs: Sequence[Evaluated], stream: rr.RecordingStream) -> list[_Shown]:
    """``runs`` with their clocks and cameras, which runs on one recording share."""
    first_on: dict[Path, Evaluated] = {}
    begins: dict[str, int] = {}
    out = []
    for run, (colour, _) in zip(runs, looks(runs), strict=True):
        flown = None if run.folder is None else run.folder.dataset_config().path
        first = run if flown is None else first_on.setdefault(flown, run)
        begin_ns = begins.setdefault(first.name, _first_stamp_ns(run))
        begin_ns = begin_ns if run.ground_truth is None else int(run.ground_truth.t_ns[0])
        # There are no dashes to tell what loop closure made of a run from the run itself.
        rgba = faint(rgba_of(colour)) if run.loop_closed else rgba_of(colour)
        out.append(_Shown(stream, run, rgba, begin_ns, entity("world", first.name, "body")))
    return out


def _first_stamp_ns(run: Evaluated) -> int:
    timings = run.folder.timings() if run.folder else None
    stamped = timings or run.estimate
    return 0 if stamped is None else int(stamped.t_ns[0])


def _log_truths(shown: Iterable[_Shown]) -> None:
    """The ground truth of runs on one recording once."""
    import rerun as rr

    seen: list[bytes] = []
    for each in shown:
        truth = each.run.ground_truth
        if each.run.errors is None or truth is None or truth.t_ns.tobytes() in seen:
            continue
        seen.append(truth.t_ns.tobytes())
        name = "ground truth" if len(seen) == 1 else f"ground truth {len(seen)}"
        grey, at = rgba_of(TRUTH_COLOUR), entity("world", name, "body")
        each.log(entity("world", name), rr.LineStrips3D([truth.p_WB], colors=grey, radii=_TRUTH))
        each.log(at, rr.Points3D.from_fields(colors=grey, radii=-4.0))
        each.send(at, truth.t_ns, rr.Points3D.columns(positions=truth.p_WB))


def _log_images(shown: Iterable[_Shown], installed: Registry) -> None:
    """The images that were flown, once for each recording."""
    for each in _first_on_each_recording(shown):
        tracks = each.run.folder.tracks() if each.run.folder else None
        if each.run.folder is None or tracks is None:
            continue
        names, wanted = _camera_names(each.run.folder), set(tracks.frames_ns.tolist())
        for frames in _frames(each.run.folder, installed, int(tracks.frames_ns[-1])):
            each.stream.set_time(TIME, duration=(frames.t_ns - each.begin_ns) / NS_PER_S)
            for name, image in zip(names, frames.images if frames.t_ns in wanted else (), strict=False):
                if image is not None:
                    each.stream.log(entity(each.images_at, name, "image"), jpeg(image))


def _first_on_each_recording(shown: Iterable[_Shown]) -> Iterable[_Shown]:
    """The runs at whose cameras the images are."""
    firsts: dict[str, _Shown] = {}
    for each in shown:
        if each.run.folder is not None:
            firsts.setdefault(each.images_at, each)
    return firsts.values()


def _camera_names(folder: RunFolder) -> list[str]:
    """Of the rig that was flown, in its order."""
    calibration = folder.calibration()
    return ["camera"] if calibration is None else [camera.name for camera in calibration.cameras]


def _frames(folder: RunFolder, installed: Registry, last_t_ns: int) -> Iterator[FrameSet]:
    """The frames of the recording that was flown, up to a stamp; none where it is gone or no longer to be read."""
    flown = folder.dataset_config()
    if flown.path is None or not flown.path.exists():
        return
    try:
        for measurement in installed.open_dataset(flown.path, flown.reader, flown.options).measurements():
            if isinstance(measurement, FrameSet):
                if measurement.t_ns > last_t_ns:
                    return
                yield measurement
    except VioframeError:
        return  # a run is shown without its images, too


def _blueprint(shown: Sequence[_Shown]) -> rrb.Blueprint:
    """The world at the left; at the right the images and, in tabs, what goes with the time."""
    import rerun.blueprint as rrb

    cameras = [
        entity(each.images_at, name)
        for each in _first_on_each_recording(shown)
        if each.run.folder is not None
        for name in _camera_names(each.run.folder)
    ]
    images = [image_view(path) for path in cameras]
    over_time = [axes_view(name, title) for name, title in _TITLES.items()]
    work = [
        rrb.TimeSeriesView(origin=origin, name=title)
        for origin, title in (("time", "time a frame [ms]"), ("stages", "by stage [ms]"), ("features", "features"))
    ]
    beside = rrb.Vertical(
        *([rrb.Tabs(*images)] if images else []), rrb.Tabs(*over_time, rrb.Vertical(*work, name="work"))
    )
    world = rrb.Spatial3DView(origin="world", name="world", eye_controls=_broadside(shown))
    return rrb.Blueprint(rrb.Horizontal(world, beside, column_shares=[3, 2]), collapse_panels=True)


def _broadside(shown: Sequence[_Shown]) -> rrb.EyeControls3D:
    """From above and across the longest way of the paths, all of which are in view."""
    import rerun.blueprint as rrb

    p_W = np.concatenate([path.p_WB for each in shown if (path := each.run.aligned) is not None])
    middle = 0.5 * (p_W.min(axis=0) + p_W.max(axis=0))
    reach = max(float(np.linalg.norm(p_W - middle, axis=1).max()), 0.5)
    across = np.linalg.svd(p_W[:, :2] - middle[:2], full_matrices=True)[2][1]
    eye = middle + 2.2 * reach * np.array([*across, 0.6])
    return rrb.EyeControls3D(position=eye, look_target=middle, eye_up=(0.0, 0.0, 1.0))


def image_view(camera: str) -> rrb.Spatial2DView:
    """The image of the entity ``camera`` with the tracks in it."""
    import rerun.blueprint as rrb

    return rrb.Spatial2DView(origin=camera, contents=["$origin/image", "$origin/tracks/**"])


def axes_view(name: str, title: str, **options: Any) -> rrb.Vertical:
    """Of what is called ``name`` a plot each for x, y and z; ``options`` are those of a plot."""
    import rerun.blueprint as rrb

    # It would hide half of so low a plot; a line that is pointed at says its name.
    options["plot_legend"] = rrb.PlotLegend(visible=False)
    return rrb.Vertical(
        *(rrb.TimeSeriesView(origin=entity(name, axis), name=axis, **options) for axis in "xyz"), name=title
    )


def open_sink(
    stream: rr.RecordingStream,
    save: Path | None,
    blueprint: rrb.Blueprint,
    option: str = "--save",
    memory_limit: str = "75%",
    *,
    index: bool = True,
) -> None:
    """Have ``stream`` shown in a window, which keeps as much as ``memory_limit``, or written to ``save``.

    The file ends in an ``index``, which grows in memory until then; a viewer opens one without, too.

    Raises :class:`RunError` where there is no display, which ``option`` does without, no viewer, or the file cannot be
    written.
    """
    import rerun as rr

    if save is None:
        _check_display(option)
        # It is installed with this Python, the folder of which need not be among those that are searched for programs.
        viewer = shutil.which("rerun", path=os.fspath(Path(sys.executable).parent))
        try:
            rr.spawn(executable_path=viewer, memory_limit=memory_limit, default_blueprint=blueprint, recording=stream)
        except RuntimeError as error:
            why = str(error).splitlines()[0]
            raise RunError(f"the viewer does not start: {why} Write a recording instead, {option} FILE.rrd") from error
        return
    try:
        save.parent.mkdir(parents=True, exist_ok=True)
        save.touch()
    except OSError as error:
        raise RunError(f"cannot write {save}: {error.strerror}; choose another name") from error
    stream.save(save, default_blueprint=blueprint, write_footer=index)


def times(t_ns: Int, begin_ns: int) -> rr.TimeColumn:
    """(N,) stamps on the time line."""
    import rerun as rr

    return rr.TimeColumn(TIME, duration=(np.asarray(t_ns) - begin_ns).astype("timedelta64[ns]"))


def frustum(camera: CameraOnBody, colour: int) -> tuple[rr.Transform3D, rr.Pinhole]:
    """A camera and where it is on the body. Its lens bends the outermost rays a little away from what is drawn."""
    import rerun as rr

    pinhole = rr.Pinhole(
        image_from_camera=camera.model.K,
        resolution=camera.model.resolution,
        image_plane_distance=_FRUSTUM_M,
        color=colour,
    )
    return rr.Transform3D(translation=camera.p_BC, mat3x3=camera.R_BC), pinhole


def jpeg(image: Image, quality: int = _JPEG_QUALITY) -> rr.EncodedImage:
    """An image as it is shown, behind its tracks."""
    import cv2
    import rerun as rr

    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg", draw_order=-1.0)


def ellipsoids_of(cov: Float) -> tuple[Float, Float]:
    """Half sizes (N, 3) and quaternions (N, 4) of three standard deviations, from covariances (N, 3, 3)."""
    variance, axes = np.linalg.eigh(cov)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    return SIGMAS * np.sqrt(np.maximum(variance, 0.0)), so3.to_quat_xyzw(axes)


def within_bounds(values: Float, sigma: Float, *, centred: bool = False) -> Float:
    """``values`` (N, 3) with the bounds around them or, if ``centred``, around zero: (N, 3, 3), the last axis lines."""
    middle = 0.0 if centred else values
    return np.stack([values, middle - SIGMAS * sigma, middle + SIGMAS * sigma], axis=2)


def line_style(name: str, colour: int, lines: int = 1) -> rr.SeriesLines:
    """Of a line, or of one and its bounds."""
    import rerun as rr

    return rr.SeriesLines(
        colors=np.array([colour, faint(colour), faint(colour)][:lines], np.uint32),
        widths=[1.5, 0.75, 0.75][:lines],
        names=[name, "-3σ", "+3σ"][:lines],
    )


def rgba_of(colour: str) -> int:
    """0xRRGGBBAA of ``#RRGGBB``."""
    return int(colour[1:], 16) << 8 | 0xFF


def faint(rgba: int) -> int:
    """Halfway to white."""
    return rgba >> 1 & 0x7F7F7F7F | 0x808080FF


def entity(*parts: str) -> str:
    """An entity path of ``parts``, the first of which may be one already."""
    import rerun as rr

    return "/".join([parts[0], *(rr.escape_entity_path_part(part) for part in parts[1:])])


def _check_display(option: str) -> None:
    """Raise :class:`RunError` where no window can be opened; ``option`` writes a file instead."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RunError(
            f"there is no display, so no viewer can be opened here; write a recording, {option} FILE.rrd, and look at "
            "it where there is one: rerun FILE.rrd"
        )
