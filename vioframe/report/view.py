"""Runs as a rerun recording: paths, cameras, images with tracks, landmarks, errors and times on one time line.

What it shows and how to read it: ``docs/view.md``. Runs are told apart by their colours, as in the plots.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.errors import RunError, VioframeError, needs
from vioframe.geometry.meshes import read_mesh
from vioframe.report.style import TRUTH_COLOUR, looks
from vioframe.runs.evaluated import Evaluated
from vioframe.runs.folder import RunFolder
from vioframe.types import DBA, DBG, DP, DTHETA, NS_PER_S, Float, FrameSet, Int

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from vioframe.parts.registry import Registry

_TIME = "time"
_SIGMAS = 3.0
_JPEG_QUALITY = 80
_FRUSTUM_M = 0.25
# The world is seen through, as it would hide what flies in it.
_GLASS = (120, 130, 150, 24)
# In points of the screen, which rerun tells from metres by their sign.
_LINE, _TRUTH, _LANDMARK, _IN_VIEW, _TRACK = -2.0, -1.0, -1.0, -2.5, 3.0
_POSITION, _ROTATION, _VELOCITY, _BIAS_GYRO, _BIAS_ACCEL = "position", "rotation", "velocity", "bias_gyro", "bias_accel"
_TITLES = {
    _POSITION: "position error [m]",
    _ROTATION: "rotation error [deg]",
    _VELOCITY: "velocity [m/s]",
    _BIAS_GYRO: "gyroscope bias [rad/s]",
    _BIAS_ACCEL: "accelerometer bias [m/s²]",
}


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
        if save is None:
            _check_display()
            stream.spawn(default_blueprint=blueprint)
        else:
            try:
                save.parent.mkdir(parents=True, exist_ok=True)
                save.touch()
            except OSError as error:
                raise RunError(f"cannot write {save}: {error.strerror}; choose another name") from error
            stream.save(save, default_blueprint=blueprint)
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
        return _faint(self.colour)

    def in_world(self, *parts: str) -> str:
        """The entity of this run that is called so."""
        return _path("world", self.run.name, *parts)

    def log(self, path: str, what: Any) -> None:
        """What holds all the time."""
        self.stream.log(path, what, static=True)

    def send(self, path: str, t_ns: Int, columns: Any) -> None:
        """What changes over time: a row a stamp."""
        import rerun as rr

        duration = (np.asarray(t_ns) - self.begin_ns).astype("timedelta64[ns]")
        self.stream.send_columns(path, [rr.TimeColumn(_TIME, duration=duration)], columns)

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
        from scipy.spatial.transform import Rotation

        estimate = self.run.aligned
        if estimate is None:
            return
        strips = np.split(estimate.p_WB, self.run.breaks(estimate.t_ns))
        self.log(self.in_world("path"), rr.LineStrips3D(strips, radii=_LINE, colors=self.colour))
        poses = rr.Transform3D.columns(translation=estimate.p_WB, quaternion=estimate.quat_xyzw)
        self.send(self.in_world("body"), estimate.t_ns, poses)
        if estimate.cov_pose is None:
            return
        known = np.isfinite(estimate.cov_pose).all(axis=(1, 2))
        variance, axes = np.linalg.eigh(estimate.cov_pose[known, DP, DP])
        axes[:, :, 0] *= np.linalg.det(axes)[:, None]
        ellipsoids = rr.Ellipsoids3D.columns(
            centers=estimate.p_WB[known],
            half_sizes=_SIGMAS * np.sqrt(np.maximum(variance, 0.0)),
            quaternions=Rotation.from_matrix(axes).as_quat(),
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
            self._series(_VELOCITY, states.t_ns, states.v_WB @ R_GW.T)
            self._series(_BIAS_GYRO, states.t_ns, states.bias_gyro_B, states.sigma[:, DBG])
            self._series(_BIAS_ACCEL, states.t_ns, states.bias_accel_B, states.sigma[:, DBA])

    def _series(
        self, name: str, t_ns: Int, values: Float, sigma: Float | None = None, *, centred: bool = False
    ) -> None:
        """``values`` (N, 3) along x, y, z, with bounds around them or, if ``centred``, around zero."""
        import rerun as rr

        breaks = self.run.breaks(t_ns)
        # With a NaN at every break, so that no line is drawn where nothing was estimated.
        stamps = np.insert(t_ns, breaks, t_ns[breaks] - 1)
        lines = [values]
        if sigma is not None and np.isfinite(sigma).any():
            middle = 0.0 if centred else values
            lines += [middle - _SIGMAS * sigma, middle + _SIGMAS * sigma]
        rows = np.insert(np.stack(lines, axis=2), breaks, np.nan, axis=0)
        for k, axis in enumerate("xyz"):
            path, faint = _path(name, axis, self.run.name), self.faint
            style = rr.SeriesLines(
                colors=np.array([self.colour, faint, faint][: len(lines)], np.uint32),
                widths=[1.5, 0.75, 0.75][: len(lines)],
                names=[f"{axis} {self.run.name}", "-3σ", "+3σ"][: len(lines)],
            )
            self.log(path, style)
            columns = rr.Scalars.columns(scalars=rows[:, k].ravel()).partition([len(lines)] * len(rows))
            self.send(path, stamps, columns)

    def _times(self, folder: RunFolder) -> None:
        """Milliseconds by stage and in all; features tracked, and new among them."""
        import rerun as rr

        timings, tracks = folder.timings(), folder.tracks()
        if timings is None:
            return
        name = self.run.name
        spent = {stage: 1e3 * seconds for stage, seconds in timings.exclusive().items()}
        series: dict[str, Float | Int] = {_path("stages", name, stage): each for stage, each in spent.items()}
        named = {_path("time", name): (name, np.sum(list(spent.values()), axis=0))}
        if tracks is not None:
            named |= {
                _path("features", name, "tracked"): (name, tracks.tracked),
                _path("features", name, "new"): (f"{name}, new", tracks.new),
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
                path, camera = self.in_world("body", name), calibration.cameras[place]
                self.log(path, rr.Transform3D(translation=camera.p_BC, mat3x3=camera.R_BC))
                # The lens bends the outermost rays a little away from the frustum that is drawn.
                pinhole = rr.Pinhole(
                    image_from_camera=camera.model.K,
                    resolution=camera.model.resolution,
                    image_plane_distance=_FRUSTUM_M,
                    color=self.colour,
                )
                self.log(path, pinhole)
            if tracks is not None:
                own = tracks.seen_by(place)
                rgba = np.where(own.is_new, 0xFFFFFFFF, self.colour).astype(np.uint32)
                points = rr.Points2D.columns(positions=own.xy, colors=rgba, radii=np.full(len(rgba), _TRACK))
                path = _path(self.images_at, name, "tracks", self.run.name)
                self.send(path, own.frames_ns, points.partition(own.tracked))

    def _landmarks(self, folder: RunFolder) -> None:
        """The map without the landmarks that stand alone and, larger, those of them that a frame tracks."""
        import rerun as rr

        landmarks, tracks = self.run.landmarks(), folder.tracks()
        if landmarks is None:
            return
        path = self.in_world("landmarks")
        self.log(path, rr.Points3D(landmarks.p_WF, colors=self.faint, radii=_LANDMARK))
        if tracks is None:
            return
        row = np.searchsorted(landmarks.ids, tracks.ids).clip(max=len(landmarks) - 1)
        known = np.flatnonzero(landmarks.ids[row] == tracks.ids)
        counts = np.array([np.count_nonzero(tracks.t_ns[known] == t) for t in tracks.frames_ns])
        large = self.in_world("landmarks in view")
        self.log(large, rr.Points3D.from_fields(colors=self.colour, radii=_IN_VIEW))
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
        rgba = _faint(_rgba(colour)) if run.loop_closed else _rgba(colour)
        out.append(_Shown(stream, run, rgba, begin_ns, _path("world", first.name, "body")))
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
        grey, at = _rgba(TRUTH_COLOUR), _path("world", name, "body")
        each.log(_path("world", name), rr.LineStrips3D([truth.p_WB], colors=grey, radii=_TRUTH))
        each.log(at, rr.Points3D.from_fields(colors=grey, radii=-4.0))
        each.send(at, truth.t_ns, rr.Points3D.columns(positions=truth.p_WB))


def _log_images(shown: Iterable[_Shown], installed: Registry) -> None:
    """The images that were flown, once for each recording."""
    import cv2
    import rerun as rr

    for each in _first_on_each_recording(shown):
        tracks = each.run.folder.tracks() if each.run.folder else None
        if each.run.folder is None or tracks is None:
            continue
        names, wanted = _camera_names(each.run.folder), set(tracks.frames_ns.tolist())
        for frames in _frames(each.run.folder, installed, int(tracks.frames_ns[-1])):
            each.stream.set_time(_TIME, duration=(frames.t_ns - each.begin_ns) / NS_PER_S)
            for name, image in zip(names, frames.images if frames.t_ns in wanted else (), strict=False):
                if image is not None:
                    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
                    encoded = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg", draw_order=-1.0)
                    each.stream.log(_path(each.images_at, name, "image"), encoded)


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
        _path(each.images_at, name)
        for each in _first_on_each_recording(shown)
        if each.run.folder is not None
        for name in _camera_names(each.run.folder)
    ]
    images = [rrb.Spatial2DView(origin=path, contents=["$origin/image", "$origin/tracks/**"]) for path in cameras]
    legend = rrb.PlotLegend(
        visible=False
    )  # it would hide half of so low a plot; a line that is pointed at says its name
    over_time = [
        rrb.Vertical(
            *(rrb.TimeSeriesView(origin=_path(name, axis), name=axis, plot_legend=legend) for axis in "xyz"), name=title
        )
        for name, title in _TITLES.items()
    ]
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


def _rgba(colour: str) -> int:
    """0xRRGGBBAA of ``#RRGGBB``."""
    return int(colour[1:], 16) << 8 | 0xFF


def _faint(rgba: int) -> int:
    """Halfway to white."""
    return rgba >> 1 & 0x7F7F7F7F | 0x808080FF


def _path(*parts: str) -> str:
    """An entity path of ``parts``, the first of which may be one already."""
    import rerun as rr

    return "/".join([parts[0], *(rr.escape_entity_path_part(part) for part in parts[1:])])


def _check_display() -> None:
    """Raise :class:`RunError` where no window can be opened."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RunError(
            "there is no display, so no viewer can be opened here; write a recording, --save FILE.rrd, and look at it "
            "where there is one: rerun FILE.rrd"
        )
