"""The types that cross a stage border: vioframe's glossary.

Conventions (``docs/conventions.md``): W world (z up), B body = IMU, C camera, F feature. ``p_A = R_AB @ p_B + p_AB``.
A trailing letter names the frame of expression. Time is integer nanoseconds of the *camera* clock: synchronisation
moves IMU stamps there (``t_imu = t_cam + time_offset``), so that nothing downstream knows of two clocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Bool, Float, Image, Int
from vioframe.errors import CalibrationError, ConfigError
from vioframe.geometry.cameras import Camera
from vioframe.geometry.trajectory import Trajectory

Int32 = NDArray[np.int32]

NS_PER_S = 1_000_000_000

MOST_APART_S = 0.06
"""Images of two cameras that are farther apart than this are of different moments, s."""

GRAVITY_M_S2 = 9.81
"""Magnitude of gravity used everywhere, m/s^2."""

g_W: Float = np.array([0.0, 0.0, -GRAVITY_M_S2])
"""Gravity in the world frame, (3,) m/s^2; ``accel_B = R_WB.T @ (a_W - g_W) + bias + noise``."""
g_W.flags.writeable = False

# The error state [dtheta dp dv dbg dba], (15,), with R <- R Exp(dtheta) and everything else additive.
DTHETA = slice(0, 3)
DP = slice(3, 6)
DV = slice(6, 9)
DBG = slice(9, 12)
DBA = slice(12, 15)


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One reading of the IMU: ``gyro_B`` (3,) rad/s and ``accel_B`` (3,) m/s^2, the specific force."""

    t_ns: int
    gyro_B: Float
    accel_B: Float


@dataclass(frozen=True, slots=True)
class FrameSet:
    """The images that a rig's cameras took at one instant, the stamp of their exposure.

    ``images`` has a place for each camera of the rig, in its order: (H, W) uint8 and read-only, or None where a camera
    brings none. Cameras that are triggered together come in one set; those with stamps of their own in sets of one.
    """

    t_ns: int
    images: tuple[Image | None, ...]


@dataclass(frozen=True, slots=True)
class Unreadable:
    """Something in a recording that its reader had to pass over, so that synchronisation can count it.

    ``kind`` is a name for :class:`~vioframe.incidents.Incidents`, such as ``frame_unreadable``.
    """

    t_ns: int
    kind: str
    detail: str


Measurement = ImuSample | FrameSet | Unreadable


@dataclass(frozen=True, slots=True)
class ImuSegment:
    """All inertial readings from one frame to the next; both ends are interpolated onto the two frame stamps.

    ``t_ns`` (N,) strictly increasing, ``gyro_B`` (N, 3) rad/s, ``accel_B`` (N, 3) m/s^2. The segment of the very first
    frame holds a single reading. ``largest_gap_s`` is the longest stretch without a *recorded* reading.
    """

    t_ns: Int
    gyro_B: Float
    accel_B: Float
    largest_gap_s: float = 0.0

    @property
    def dt(self) -> Float:
        """(N - 1,) seconds between readings."""
        return np.diff(self.t_ns) * 1e-9

    @property
    def duration_s(self) -> float:
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9


@dataclass(frozen=True, slots=True)
class Keypoints:
    """What a detector found, strongest first: ``xy`` (N, 2) float32 px, ``score`` (N,), ``descriptors`` (N, D) or None.

    Integers are pixel centres.
    """

    xy: NDArray[np.float32]
    score: NDArray[np.float32]
    descriptors: NDArray[np.generic] | None = None


@dataclass(frozen=True, slots=True)
class FrameTracks:
    """The features seen in one frame: ``ids`` (N,), ``xy`` (N, 2) px, ``xy_normalised`` (N, 2) with z = 1.

    ``camera`` (N,) is the place in the rig of the camera that saw each. An id is unique within a camera; the same id in
    two cameras is the same landmark.
    """

    t_ns: int
    ids: Int
    camera: Int
    xy: Float
    xy_normalised: Float

    @classmethod
    def none(cls, t_ns: int) -> FrameTracks:
        """A frame in which nothing is seen."""
        return cls(t_ns, np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)))

    def only(self, keep: Bool) -> FrameTracks:
        """The features ``keep`` (N,)."""
        return FrameTracks(self.t_ns, self.ids[keep], self.camera[keep], self.xy[keep], self.xy_normalised[keep])

    def of_camera(self, camera: int) -> FrameTracks:
        """What the one at this place in the rig sees."""
        return self if not self.camera.any() and camera == 0 else self.only(self.camera == camera)

    @property
    def by_others_alone(self) -> bool:
        """Whether cameras take turns, and this was not the first one's."""
        return bool(len(self.ids)) and bool(self.camera.all())

    def undistorted(self, *lenses: Camera, by: tuple[Camera, ...] | None = None) -> FrameTracks:
        """The same pixels as the ``lenses`` of the rig have them on the z = 1 plane.

        Nothing changes where those ``by`` which they have been undistorted are the same.
        """
        if lenses == by:
            return self
        xy_normalised = np.empty_like(self.xy)
        for c, lens in enumerate(lenses):
            xy_normalised[self.camera == c] = lens.undistort(self.xy[self.camera == c])
        return replace(self, xy_normalised=xy_normalised)

    def finite(self) -> FrameTracks:
        """Without the points that could not be undistorted."""
        good = np.asarray(np.isfinite(self.xy_normalised).all(axis=1))
        return self if good.all() else self.only(good)


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Continuous-time noise densities of an IMU, as Kalibr and EuRoC state them; ``rate_hz`` is its nominal rate."""

    gyro_density: float
    """White noise of the gyroscope, rad/s/sqrt(Hz)."""
    accel_density: float
    """White noise of the accelerometer, m/s^2/sqrt(Hz)."""
    gyro_walk: float
    """Diffusion of the gyroscope's bias, rad/s^2/sqrt(Hz)."""
    accel_walk: float
    """Diffusion of the accelerometer's bias, m/s^3/sqrt(Hz)."""
    rate_hz: float = 200.0

    def times(self, gyro: float, accel: float, accel_walk: float = 1.0) -> ImuNoise:
        """With so many times the white noise of either sensor, and of the walk of the accelerometer's bias."""
        return replace(
            self,
            gyro_density=gyro * self.gyro_density,
            accel_density=accel * self.accel_density,
            accel_walk=accel_walk * self.accel_walk,
        )


@dataclass(frozen=True, slots=True)
class CameraOnBody:
    """A camera and how it sits on the body: ``p_B = R_BC @ p_C + p_BC`` and ``t_imu = t_cam + time_offset_ns``.

    Where nobody knows how the camera is turned, ``rotation_known`` is False and ``R_BC`` (3, 3) means nothing: it is
    found while initialising. ``name`` is that of its folder or topic, such as ``cam0``.

    ``readout_s`` is the time a rolling shutter takes from the first row to the last (rows times the time of one), 0 for
    a global one, negative where the last row comes first. The stamp is that of the middle row; see :meth:`row`.
    """

    name: str
    model: Camera
    R_BC: Float
    p_BC: Float
    time_offset_ns: int = 0
    rotation_known: bool = True
    readout_s: float = 0.0

    def row(self, y: Float) -> Float:
        """Where pixels at height ``y`` are between the first row and the last, from -1/2 to 1/2.

        They are exposed that part of ``readout_s`` after the stamp.
        """
        return (y + 0.5) / self.model.resolution[1] - 0.5

    def pose(self, R_WB: Float, p_WB: Float) -> tuple[Float, Float]:
        """R_WC (..., 3, 3) and p_WC (..., 3) m on a body at ``R_WB`` (..., 3, 3), ``p_WB`` (..., 3)."""
        return R_WB @ self.R_BC, p_WB + R_WB @ self.p_BC

    def seen_from(self, other: CameraOnBody) -> tuple[Float, Float]:
        """R_C2C1 (3, 3) and p_C2C1 (3,) m, from the axes of this camera, C1, to those of the ``other``, C2."""
        return other.R_BC.T @ self.R_BC, other.R_BC.T @ (self.p_BC - other.p_BC)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A rig: its cameras, in the order in which frames and tracks refer to them, and the IMU's noise."""

    cameras: tuple[CameraOnBody, ...]
    imu: ImuNoise

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if not names or len(set(names)) < len(names):
            raise CalibrationError(f"a rig needs cameras with names of their own, got {names}")

    def single(self, user: str) -> CameraOnBody:
        """The only camera; raises :class:`ConfigError` naming ``user``, who takes one, where there are more."""
        if len(self.cameras) > 1:
            names = ", ".join(camera.name for camera in self.cameras)
            choice = f"choose one, as by --cameras {self.cameras[0].name}"
            raise ConfigError(f"{user} takes one camera, the calibration has {names}; {choice}")
        return self.cameras[0]

    @property
    def lenses(self) -> tuple[Camera, ...]:
        """The models of the cameras."""
        return tuple(camera.model for camera in self.cameras)

    def only(self, index: int) -> Calibration:
        """The rig of one camera of this one."""
        return replace(self, cameras=(self.cameras[index],))

    def moved_with(self, first: CameraOnBody) -> Calibration:
        """The rig with another first camera; the others sit on it as before, and are read at the same times."""
        given = self.cameras[0]
        turn = first.R_BC @ given.R_BC.T if given.rotation_known else np.eye(3)
        late_ns = first.time_offset_ns - given.time_offset_ns
        others = (
            replace(other, R_BC=turn @ other.R_BC, time_offset_ns=other.time_offset_ns + late_ns)
            for other in self.cameras[1:]
        )
        return replace(self, cameras=(first, *others))

    def with_camera(self, index: int, **changes: Any) -> Calibration:
        """The same rig with fields of one camera changed."""
        cameras = list(self.cameras)
        cameras[index] = replace(cameras[index], **changes)
        return replace(self, cameras=tuple(cameras))


UNKNOWN_READOUT_S = 0.02
"""Standard deviation of a readout of which nobody knows more than that it is shorter than a frame."""


@dataclass(frozen=True, slots=True)
class CameraSigma:
    """Standard deviations of a camera's calibration; zero is what is taken as given.

    ``rotation`` (3,) rad and ``position`` (3,) m of the camera on the body, right perturbation; ``time_offset_s``;
    ``intrinsics`` (8,) of fx fy cx cy px and of the four distortion coefficients; ``readout_s``.
    """

    rotation: Float
    position: Float
    time_offset_s: float
    intrinsics: Float
    readout_s: float = 0.0

    def stacked(self) -> Float:
        """(16,) in the order [rotation position time_offset readout intrinsics]."""
        return np.concatenate([self.rotation, self.position, [self.time_offset_s, self.readout_s], self.intrinsics])

    @classmethod
    def of(cls, stacked: Float) -> CameraSigma:
        """From what :meth:`stacked` gives."""
        return cls(stacked[:3], stacked[3:6], float(stacked[6]), stacked[8:], float(stacked[7]))


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """What a back-end believes of the rig's calibration by now, and how sure it is of each camera's."""

    calibration: Calibration
    sigma: tuple[CameraSigma, ...]


@dataclass(frozen=True, slots=True)
class NavState:
    """Where the body is and how it moves: pose, velocity and biases at one instant.

    ``R_WB`` (3, 3), ``p_WB`` (3,) m, ``v_WB`` (3,) m/s, ``bias_gyro_B`` (3,) rad/s, ``bias_accel_B`` (3,) m/s^2.
    ``cov`` (15, 15) covers [dtheta dp dv dbg dba] (right perturbation), or is None where the back-end does not know it.
    """

    t_ns: int
    R_WB: Float
    p_WB: Float
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float
    cov: Float | None = None


@dataclass(frozen=True, slots=True)
class Start:
    """Where a back-end begins: ``state``, with covariance, at the frame that shows ``tracks`` and ends ``imu``.

    ``calibration`` is the prior of what may be calibrated on the way; its noise is that of the IMU in flight, and
    ``noise_at_rest`` that of a body that stands still.
    """

    state: NavState
    calibration: CalibrationEstimate
    noise_at_rest: ImuNoise
    imu: ImuSegment
    tracks: FrameTracks


class Status(StrEnum):
    """What a back-end can say of itself after a frame."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    LOST = "lost"


def _no_ids() -> Int:
    return np.empty(0, np.int64)


def _no_points() -> Float:
    return np.empty((0, 3))


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a back-end knows after one frame. ``state`` is None until it is initialised.

    ``landmark_ids`` (M,) and ``p_WF`` (M, 3) m are the landmarks estimated or refined at this frame. ``events`` are
    one-line notes worth keeping (an initialisation refused and why, a reset); ``stage_seconds`` is the back-end's own
    breakdown of its time. ``calibration`` is what it has learned of the rig, None where it learns nothing.
    ``corrected`` says whether what was seen had a part in it, or the readings alone led here.
    """

    status: Status
    state: NavState | None = None
    landmark_ids: Int = field(default_factory=_no_ids)
    p_WF: Float = field(default_factory=_no_points)
    is_keyframe: bool = False
    corrected: bool = True
    calibration: CalibrationEstimate | None = None
    events: tuple[str, ...] = ()
    stage_seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MapCorrection:
    """How the odometry's world W lies in the map M, W as loops have corrected it: ``p_M = R_MW @ p_W + p_MW``.

    ``R_MW`` (3, 3) turns about z alone, as gravity tells roll and pitch; ``p_MW`` (3,) m. It holds for the newest pose:
    ``R_MB = R_MW @ R_WB``, ``p_MB = R_MW @ p_WB + p_MW``. Until a loop is believed it is the identity.
    """

    R_MW: Float = field(default_factory=lambda: np.eye(3))
    p_MW: Float = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the main loop: the images, their tracks, the estimate, and seconds spent by stage.

    A stage named ``a.b`` is a part of ``a``: a back-end's own breakdown is found below ``backend``. ``correction`` is
    what loop closure knows so far, None without a loop closer that tells it while flying.
    """

    frames: FrameSet
    tracks: FrameTracks
    estimate: Estimate
    stage_seconds: Mapping[str, float]
    correction: MapCorrection | None = None


@dataclass(frozen=True, slots=True)
class Loop:
    """A place seen again: two keyframes, and where the later body is as seen from the earlier one.

    ``p_L`` (3,) m and ``yaw`` rad are in the earlier body's levelled frame L: z is up and x has the body's heading.
    ``inliers`` is the number of points that support it, ``accepted`` whether it was believed in the end.
    """

    earlier_t_ns: int
    later_t_ns: int
    p_L: Float
    yaw: float
    inliers: int
    accepted: bool


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """What a loop closer made of a run: the pose of every tracked frame, corrected, and the loops it found.

    ``trajectory`` is None where nothing was tracked; ``keyframe_t_ns`` (K,) are the frames that loops may tie together.
    ``stage_seconds`` is the time that was spent beside the main loop.
    """

    trajectory: Trajectory | None
    keyframe_t_ns: Int
    loops: tuple[Loop, ...] = ()
    stage_seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a body is and how it moves at N instants.

    ``R_WB`` (N, 3, 3), ``p_WB`` (N, 3) m, ``v_WB`` (N, 3) m/s, ``a_WB`` (N, 3) m/s^2, ``omega_B`` (N, 3) rad/s.
    """

    R_WB: Float
    p_WB: Float
    v_WB: Float
    a_WB: Float
    omega_B: Float


@dataclass(frozen=True)
class Mesh:
    """T triangles: ``corners`` (T, 3, 3) m in W, ``uv`` (T, 3, 2) in widths of the texture, which repeats.

    ``texture`` (T,) numbers the image on each; ``surface`` (T,) tells faces apart, for anti-aliasing where they meet.
    """

    corners: Float
    uv: Float
    texture: Int32
    surface: Int32

    @property
    def normals(self) -> Float:
        """(T, 3) unit normals."""
        n = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        return np.asarray(n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12))


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """What to train on and where the result goes."""

    images: tuple[Path, ...]
    """Folders of photographs, and recordings."""
    out: Path
    """Folder for checkpoint, log and weights."""
    hold_out: tuple[str, ...] = ()
    """Images whose name contains one of these, or matches it as a pattern, serve validation only."""
    start_from: Path | None = None
    """Weights to fine-tune: a file, or a name that the trainer knows."""
    resume: bool = False
    """Go on with the training in ``out``."""


@dataclass(frozen=True, slots=True)
class TrainingStep:
    """One step of a training: ``done`` of ``total``."""

    done: int
    total: int
    losses: Mapping[str, float]
    epoch: Mapping[str, float] | None = None
    """With the last step of an epoch: its means, and the validation on what is held out."""
