"""Whether camera and gyroscope belong together as their calibration says; where they do not, what would make them.

Before anything is estimated from both, the camera's turns are held against the gyroscope's. Where the given time
offset, rotation, focal length or readout leaves them further apart than others do, those are taken in its place.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vioframe.arrays import Float
from vioframe.estimation.hand_eye import HandEye, Part, Turns, top_beside
from vioframe.estimation.inertial.readings import Readings
from vioframe.estimation.initialization.found import Found
from vioframe.estimation.initialization.window import PIXEL_SIGMA, refuse_unless, seen_anew
from vioframe.estimation.turns import Turn, turn_between
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.types import NS_PER_S, Calibration, CameraOnBody, FrameTracks

# From the first frame of a pair to the second, for fast and for slow turns, and from one pair to the next.
_TURNS_NS, _STEP_NS = (190_000_000, 590_000_000), 90_000_000
_LOOK_BACK_NS = 4 * NS_PER_S
_FEWEST_TURNS = 8
# What is given fits where nothing else fits better by so much: as a part of the sum of squares, and in all.
_BETTER, _BETTER_BY = 1.3, 15.0
# ... and where what would is farther from it than this, s and rad: less than that an estimator finds by itself; and by
# more than so many standard deviations.
_NEAR: dict[Part, float] = {"offset": 0.008, "rotation": np.deg2rad(3.0)}
_INSIGNIFICANT = 2.0
# Standard deviations with which a part can be taken over, s, rad and relative.
_NAMES: dict[Part, str] = {"offset": "the time offset", "rotation": "the camera's rotation on the body"}
_SURE: dict[Part, float] = {"offset": 0.012, "rotation": np.deg2rad(1.5)}
# What distortion, rolling shutter and creeping patches cost beyond the scatter of the turns.
_SYSTEMATIC: dict[Part, float] = {"offset": 0.003, "rotation": np.deg2rad(0.5)}
# Turns are taken every so often and overlap.
_OVERLAP = 4.0
# The scatter of turns over that which the tracks' own noise gives them: up to here nothing else is tried, and beyond,
# other focal lengths, relative, and readouts, s, are too, each by some of the turns.
_WELL, _BADLY = 1.5, 1.7
_ZOOMS, _READOUTS_S = np.linspace(-0.15, 0.15, 7), np.linspace(-0.045, 0.045, 7)
_TRY_EVERY_NS, _TRIED_TURNS = 3 * NS_PER_S // 2, 15
# One must fit better by this part of the squares to be taken, and what lies next to the given one by this.
_FAR_BETTER, _VALLEY = 0.4, 0.75
# How well it is found, relative and s.
_FOCAL_SIGMA, _READOUT_SIGMA_S = 0.02, 0.004
# The part of what the camera turned that may be left unexplained.
_LARGEST_UNEXPLAINED = 0.5
# The median of |x| for x ~ N(0, 1).
_MEDIAN = 0.6745


_Pair = tuple[FrameTracks, FrameTracks, Turn]


class SensorCheck:
    """Takes frames as they come, and says what fits them."""

    def __init__(self) -> None:
        self._frames: deque[FrameTracks] = deque()
        self._pairs: deque[_Pair] = deque()
        self._tried_ns: int | None = None
        self.bias_gyro_B: Float = np.zeros(3)
        """The gyroscope's bias (3,) rad/s as the camera's turns have it, once they have been judged."""

    def reset(self) -> None:
        self._frames.clear()
        self._pairs.clear()

    def add(self, tracks: FrameTracks, camera: Camera) -> None:
        """Take one frame, with points undistorted by ``camera``."""
        t_ns = tracks.t_ns
        if self._frames and t_ns - self._frames[-1].t_ns < _STEP_NS:
            return
        while self._pairs and self._pairs[0][0].t_ns < t_ns - _LOOK_BACK_NS:
            self._pairs.popleft()
        while self._frames and self._frames[0].t_ns < t_ns - 2 * max(_TURNS_NS):
            self._frames.popleft()
        for turn_ns in _TURNS_NS:
            before = next((frame for frame in reversed(self._frames) if t_ns - frame.t_ns >= turn_ns), None)
            if before is None or t_ns - before.t_ns > 2 * turn_ns:
                continue
            if (turn := turn_between(before, tracks, PIXEL_SIGMA / camera.focal_px)) is not None:
                self._pairs.append((before, tracks, turn))
        self._frames.append(tracks)

    def see_through(self, camera: CameraOnBody, readings: Readings) -> None:
        """Count with ``camera`` from here on."""
        self._frames = deque(seen_anew(tracks, camera, readings.gyro_at(tracks.t_ns)) for tracks in self._frames)
        self._pairs = deque(_anew(self._pairs, camera, readings))

    def judge(self, readings: Readings, calibration: Calibration) -> Found | None:
        """What to take in place of ``calibration``; None where that fits, or nothing can be said.

        Raises :class:`RefusalError` where it does not fit, but what would is not known well enough yet.
        """
        camera = calibration.cameras[0]
        turns = Turns([turn for *_, turn in self._pairs], readings.t_ns, readings.gyro_B)
        if len(turns) < _FEWEST_TURNS:
            refuse_unless(camera.rotation_known, "too few tracks to tell how the camera is turned on the body")
            return None
        given = HandEye(np.zeros(3), camera.R_BC)
        noise = float(np.median([turn.misfit for *_, turn in self._pairs])) / _MEDIAN
        as_given = turns.fit(given, ()) if camera.rotation_known else None
        if as_given is not None and _fits(turns, *as_given, noise):
            self.bias_gyro_B = as_given[0].bias_gyro_B
            return None
        best, parts, variance = _best(turns, given, as_given)
        self.bias_gyro_B = best.bias_gyro_B
        if variance > (_BADLY * noise) ** 2 and (found := self._other_camera(readings, calibration, best)) is not None:
            return found
        if not parts:
            return None
        sigma = {part: _sigma(best, part) for part in parts}
        unsure = [part for part in parts if not sigma[part] <= _SURE[part]]
        what = " and ".join(_NAMES[part] for part in parts)
        wrong = f"{what} given {'do' if len(parts) > 1 else 'does'} not fit, and what does"
        refuse_unless(
            not unsure and turns.unexplained(best) < _LARGEST_UNEXPLAINED,
            f"{wrong if camera.rotation_known else what} is not known well enough yet; turn about two axes",
        )
        worse = max(np.sqrt(variance) / noise / _WELL, 1.0)
        sigma = {part: float(np.hypot(sigma[part], worse * _SYSTEMATIC[part])) for part in parts}
        offset_ns = camera.time_offset_ns + round(best.offset_s * NS_PER_S)
        return Found(
            calibration.with_camera(0, R_BC=best.R_BC, rotation_known=True, time_offset_ns=offset_ns),
            sigma.get("offset"),
            sigma.get("rotation"),
        )

    def bear_out(self, readings: Readings, calibration: Calibration) -> bool:
        """Whether the turns would tell another time offset or rotation from those of ``calibration``, which fits."""
        turns = Turns([turn for *_, turn in self._pairs], readings.t_ns, readings.gyro_B)
        if len(turns) < _FEWEST_TURNS:
            return False
        x, _ = turns.fit(HandEye(np.zeros(3), calibration.cameras[0].R_BC), ("rotation", "offset"))
        return all(_sigma(x, part) <= sure for part, sure in _SURE.items())

    def _other_camera(self, readings: Readings, calibration: Calibration, start: HandEye) -> Found | None:
        """With a focal length or a readout by which turns fit far better, if there is one; tried now and then."""
        now_ns = self._frames[-1].t_ns
        if self._tried_ns is not None and now_ns - self._tried_ns < _TRY_EVERY_NS:
            return None
        self._tried_ns = now_ns
        camera = replace(calibration.cameras[0], R_BC=start.R_BC, rotation_known=True)
        squares = partial(self._squares, readings=readings, start=start)
        as_given, _ = squares(camera)
        zoomed = [replace(camera, model=camera.model.zoomed(1.0 + zoom)) for zoom in _ZOOMS]
        if (place := _valley(zoomed, as_given, squares)) is not None:
            factor = 1.0 + np.interp(place, np.arange(len(_ZOOMS)), _ZOOMS)
            return Found(calibration.with_camera(0, model=camera.model.zoomed(factor)), focal_sigma=_FOCAL_SIGMA)
        rolling = [replace(camera, readout_s=camera.readout_s + longer_s) for longer_s in _READOUTS_S]
        if (place := _valley(rolling, as_given, squares)) is not None:
            longer_s = float(np.interp(place, np.arange(len(_READOUTS_S)), _READOUTS_S))
            if abs(longer_s) > _INSIGNIFICANT * _READOUT_SIGMA_S:
                found = calibration.with_camera(0, readout_s=camera.readout_s + longer_s)
                return Found(found, readout_sigma_s=_READOUT_SIGMA_S)
        return None

    def _squares(self, camera: CameraOnBody, readings: Readings, start: HandEye) -> tuple[float, bool]:
        """The squares by which some of the turns that ``camera`` saw are off, and whether that is no more than noise.

        They are fitted anew from ``start``; infinite where there are too few.
        """
        some = [self._pairs[k] for k in np.unique(np.linspace(0, len(self._pairs) - 1, _TRIED_TURNS).astype(int))]
        found = [turn for *_, turn in _anew(some, camera, readings)]
        turns = Turns(found, readings.t_ns, readings.gyro_B)
        if len(turns) < _FEWEST_TURNS:
            return np.inf, False
        x, variance = turns.fit(start, ("rotation", "offset"))
        noise = float(np.median([turn.misfit for turn in found])) / _MEDIAN
        return turns.cost(x, variance) * variance, variance < (_BADLY * noise) ** 2


def _valley(
    cameras: Sequence[CameraOnBody], as_given: float, squares: Callable[[CameraOnBody], tuple[float, bool]]
) -> float | None:
    """Where between ``cameras``, the given one in the middle, turns fit well, and far better than ``as_given`` there.

    None where no way leads down to it from the middle. ``squares`` are those of a camera, and whether they are noise.
    """
    given = len(cameras) // 2
    tried = {k: squares(cameras[k]) for k in (given - 1, given + 1)}
    best = min(tried, key=lambda k: tried[k][0])
    if not tried[best][0] <= _VALLEY * as_given:
        return None
    onward = best - given
    while 0 <= best + onward < len(cameras):
        tried[best + onward] = squares(cameras[best + onward])
        if not tried[best + onward][0] < tried[best][0]:
            break
        best += onward
    else:
        return None
    least, fits_well = tried[best]
    if not (fits_well and least <= _FAR_BETTER * as_given):
        return None
    about = [as_given if k == given else tried[k][0] for k in (best - 1, best, best + 1)]
    return best + top_beside(-np.log(about), 1)


def _anew(pairs: Sequence[_Pair], camera: CameraOnBody, readings: Readings) -> Iterator[_Pair]:
    """The pairs as ``camera`` saw them, and the turns they make then, where they make any."""
    frames = {tracks.t_ns: tracks for *pair, _ in pairs for tracks in pair}
    seen = {t_ns: seen_anew(tracks, camera, readings.gyro_at(t_ns)) for t_ns, tracks in frames.items()}
    for a, b, turn in pairs:
        before, now = seen[a.t_ns], seen[b.t_ns]
        anew = turn_between(before, now, PIXEL_SIGMA / camera.model.focal_px, turn.other is not None)
        if anew is not None:
            yield before, now, anew


def _fits(turns: Turns, x: HandEye, variance: float, noise: float) -> bool:
    """Whether turns scatter about ``x`` as their tracks' ``noise`` has them, and nothing near fits much better."""
    if variance > (_WELL * noise) ** 2:
        return False
    near, variance = turns.fit(x, ("rotation", "offset"))
    return turns.cost(x, variance) < turns.cost(near, variance) + _BETTER_BY


def _best(
    turns: Turns, given: HandEye, as_given: tuple[HandEye, float] | None
) -> tuple[HandEye, tuple[Part, ...], float]:
    """The fewest parts that have to be other than ``given``, how, and the variance of the turns then.

    ``as_given`` is the fit with none other; None where nobody knows how the camera is turned.
    """
    fits: dict[tuple[Part, ...], tuple[HandEye, float]] = {}
    if as_given is not None:
        fits[()] = as_given
        fits["offset",] = turns.fit(turns.nearest(given, turned=False), ("offset",))
    turned = turns.nearest(given, turned=True)
    fits["rotation",] = turns.fit(replace(turned, offset_s=0.0), ("rotation",))
    fits["rotation", "offset"] = turns.fit(turned, ("rotation", "offset"))
    variance = min(variance for _, variance in fits.values())
    costs = {parts: turns.cost(x, variance) for parts, (x, _) in fits.items()}
    limit = _BETTER * min(costs.values()) + _BETTER_BY
    enough = [parts for parts, cost in costs.items() if cost <= limit]
    # The first changes least. Where either alone would do, nothing tells which of them it is.
    either = {("offset",), ("rotation",)} <= set(enough)
    parts = enough[-1] if enough[0] and either else enough[0]
    x, _ = fits[parts]
    if as_given is not None and _is_near(x, given, parts):
        parts = ()
    return x, parts, variance


def _is_near(x: HandEye, given: HandEye, parts: Sequence[Part]) -> bool:
    off = {"offset": abs(x.offset_s), "rotation": float(np.linalg.norm(so3.log(given.R_BC.T @ x.R_BC)))}
    return all(off[part] <= max(_NEAR[part], _INSIGNIFICANT * _sigma(x, part)) for part in parts)


def _sigma(x: HandEye, part: Part) -> float:
    return float(x.sigma(part) * np.sqrt(_OVERLAP))
