"""What the tracker teaches: points of simulated flights, each followed as in flight, and what became of it.

Repeatability, which the published losses train for, is not what tracking asks for: no point is ever found again, its
patch is followed. In a simulated world it is known how far from its landmark that led, and so which points to choose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, pixel_shuffle

from vioframe.errors import ConfigError
from vioframe.evaluation.tracks import landmarks_of
from vioframe.frontend import FrontendOptions
from vioframe.frontend.flow import body_rotation
from vioframe.frontend.view import BORDER_PX, Shown, View
from vioframe.geometry.cameras import Camera
from vioframe.geometry.meshes import read_mesh
from vioframe.incidents import Incidents
from vioframe.io.synchronise import synchronise
from vioframe.parts import registry
from vioframe.simulation.config import MESH, simulation_folder
from vioframe.stopwatch import Stopwatch
from vioframe.types import Bool, Float, FrameTracks
from vioframe_keypointnet.network import KeypointNet
from vioframe_keypointnet.options import Target, TrainingOptions, TrainingPrecision
from vioframe_keypointnet.selection import padded_to_cells
from vioframe_keypointnet.training.samples import Picture

IMAGES = 60
"""In how many images a point is followed, at most: three seconds at 20 Hz."""
_KNOWN = 20
"""In fewer nothing is learned of it."""
_STEEPEST = 0.5
"""From which share of the pixels points are drawn: among them bad ones, or there is nothing to be told."""
_EDGE_PX = 10.0
"""Points so near the edge of a crop are seen in part."""

_STRAYED_PX = 1.0
"""So far from its landmark a point does more harm than good."""
_DRIFT_PX = 0.5
_FINEST_PX = 0.1
"""Points that are followed more closely than this are all as good."""


@dataclass(frozen=True, slots=True)
class Followed(Picture):
    """An image of a flight, as a detector is given it, and N of its points as they were followed from there."""

    xy: NDArray[np.float32]
    """(N, 2) px."""
    off_px: NDArray[np.float16]
    """(N, IMAGES) how far from its landmark each was in the images after; infinite where it was lost."""
    known: Bool
    """(N, IMAGES) False once the landmark has left the image or the recording has ended: that is no fault of a point.
    """


def follow(recording: Path, *, every: int = 6, points: int = 600, apart_px: float = 6.0) -> list[Followed]:
    """Follow so many ``points``, ``apart_px`` or more from each other, through a simulated ``recording``.

    They are drawn anew in one of ``every`` so many images of the first of its cameras.

    Raises :class:`ConfigError` where it was not simulated: nobody knows its landmarks.
    """
    installed = registry.load()
    dataset = installed.open_dataset(recording)
    mesh = simulation_folder(recording) / MESH
    truth, calibration = dataset.ground_truth, dataset.calibration
    if truth is None or not mesh.is_file():
        raise ConfigError(f"{recording} was not simulated: nobody knows where its points are; use `vioframe simulate`")
    camera, options = calibration.cameras[0], FrontendOptions(max_points=points, min_distance_px=apart_px)
    detector = installed.create_detector("random", {"steepest": _STEEPEST, "min_distance_px": apart_px})
    incidents, watch = Incidents(), Stopwatch()
    t_ns: list[int] = []
    begun: list[_Set] = []
    for imu, frames in synchronise(dataset.measurements(), incidents=incidents):
        image = frames.images[0]
        if image is None or not truth.covers([frames.t_ns])[0]:
            continue
        R_C2C1 = camera.R_BC.T @ body_rotation(imu).T @ camera.R_BC
        shown = Shown.of(image, options, watch)
        for drawn in begun:
            drawn.advance(shown, R_C2C1, frames.t_ns, watch)
        if len(t_ns) % every == 0 and shown.pyramid is not None:
            view = View(detector, camera.model, options, incidents)
            begun.append(_Set(len(t_ns), shown, view, points, frames.t_ns, watch))
        t_ns.append(frames.t_ns)
    motion, corners = truth.at(t_ns), read_mesh(mesh)
    R_WC, p_WC = camera.pose(motion.R_WB, motion.p_WB)
    out = []
    for number, drawn in enumerate(begun):
        seen = slice(drawn.first, drawn.first + IMAGES + 1)
        off_px, known = _fates(drawn.xy, R_WC[seen], p_WC[seen], camera.model, corners)
        xy = drawn.xy[:, 0].astype(np.float32)
        out.append(Followed(f"{recording}#{number}", drawn.image, xy, off_px.astype(np.float16), known))
    return out


def _fates(xy: Float, R_WC: Float, p_WC: Float, camera: Camera, corners: Float) -> tuple[Float, Bool]:
    """``off_px`` and ``known`` of :class:`Followed`: of points ``xy`` (N, IMAGES + 1, 2) px seen from poses (S, ...).

    ``corners`` (T, 3, 3) m are those of the world's triangles; there are fewer poses where the recording ends.
    """
    ids = np.arange(len(xy))
    found = FrameTracks(0, ids, np.zeros_like(ids), xy[:, 0], camera.undistort(xy[:, 0]))
    p_WF = landmarks_of([found], R_WC[:1], p_WC[:1], corners)
    off_px, known = np.full((len(xy), IMAGES), np.inf), np.zeros((len(xy), IMAGES), bool)
    for k, (R, p) in enumerate(zip(R_WC[1:], p_WC[1:], strict=True)):
        p_CF = (p_WF - p) @ R
        true_xy = camera.project(p_CF)
        distance = np.linalg.norm(xy[:, k + 1] - true_xy, axis=1)
        off_px[:, k] = np.where(np.isfinite(distance), distance, np.inf)
        known[:, k] = camera.contains(true_xy, BORDER_PX) & (p_CF[:, 2] > 0.0)
    return off_px, np.logical_and.accumulate(known, axis=1)


class _Set:
    """``most`` points drawn in image ``first``, which ``shown`` is; ``xy`` (N, IMAGES + 1, 2) px, NaN where lost."""

    def __init__(self, first: int, shown: Shown, view: View, most: int, t_ns: int, watch: Stopwatch) -> None:
        view.advance(shown, None, t_ns, watch)
        count = view.refill(0, t_ns, most)
        self.first, self.image = first, np.asarray(shown.image, np.uint8)
        self.xy: Float = np.full((count, IMAGES + 1, 2), np.nan)
        self.xy[view.ids, 0] = view.xy
        self._view, self._images = view, 0

    def advance(self, shown: Shown, R_C2C1: Float, t_ns: int, watch: Stopwatch) -> None:
        if self._images < IMAGES and len(self._view.ids):
            self._view.advance(shown, R_C2C1, t_ns, watch)
            self._images += 1
            self.xy[self._view.ids, self._images] = self._view.xy


def wanted(target: Target, followed: Followed) -> tuple[Float, Bool]:
    """(N,) what a network is to say of each point, in [0, 1], and of which there is enough known to teach it (N,)."""
    known, off_px = followed.known, followed.off_px.astype(np.float32)
    there = known & np.isfinite(off_px)
    return _TARGETS[target](np.where(there, off_px, 0.0), there, known), known.sum(axis=1) >= _KNOWN


def _life(_: Float, there: Bool, known: Bool) -> Float:
    return _share(there, known)


def _drift(off_px: Float, there: Bool, _: Bool) -> Float:
    mean_square = np.square(off_px).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    return np.asarray(there.any(axis=1) / (1.0 + mean_square / _DRIFT_PX**2))


def _faithful(off_px: Float, there: Bool, known: Bool) -> Float:
    stays = there & (off_px <= _STRAYED_PX)
    return _share(np.logical_and.accumulate(stays, axis=1), known)


def _information(off_px: Float, there: Bool, known: Bool) -> Float:
    # By what is usual in the image: also where all points stray, as under blur, there are those to be preferred.
    usual_px = 2.0 * float(np.median(off_px[there])) if there.any() else 0.0
    variance = max(usual_px, _FINEST_PX) ** 2
    return _share(there * variance / (variance + np.square(off_px)), known)


def _clean(off_px: Float, there: Bool, _: Bool) -> Float:
    return np.asarray(there.any(axis=1) & (off_px <= _STRAYED_PX).all(axis=1), float)


def _share(of: NDArray[np.generic], known: Bool) -> Float:
    """(N,) what ``of`` (N, IMAGES) is on average while a point is known."""
    return np.asarray(of.sum(axis=1) / np.maximum(known.sum(axis=1), 1))


# Each of how far points are off (N, IMAGES), 0 where they are not followed; where they are; and where that is known.
_TARGETS: dict[Target, Callable[[Float, Bool, Bool], Float]] = {
    "life": _life,
    "drift": _drift,
    "faithful": _faithful,
    "information": _information,
    "clean": _clean,
}
assert {*_TARGETS, "repeatability"} == {*get_args(Target)}


def responses(network: KeypointNet, images: Tensor) -> Tensor:
    """(B, H, W) the response of a network of peaks to each pixel of ``images`` (B, 1, H, W) in [0, 1]."""
    response = network.found(images, descriptors=False)[0].permute(0, 3, 1, 2)
    return pixel_shuffle(response, network.architecture.fold)[:, 0]


class Told(NamedTuple):
    """Crops of a batch of pictures, and what a network is to say of K points in them."""

    crops: Tensor
    """(B, 1, H, W) uint8."""
    at: Tensor
    """(K, 3) crop, row and column of each point."""
    score: Tensor
    """(K,) in [0, 1]."""


def told(pictures: Sequence[Followed], options: TrainingOptions, step: int) -> Told:
    """What a step is trained on, made of nothing but the arguments."""
    rng = np.random.default_rng([options.seed, 4, step])
    width, height = options.size
    crops, at, scores = [], [], []
    for number, picture in enumerate(pictures[k] for k in rng.integers(len(pictures), size=options.batch)):
        rows, columns = picture.pixels.shape
        top, left = rng.integers(0, rows - height + 1), rng.integers(0, columns - width + 1)
        crop = picture.pixels[top : top + height, left : left + width]
        score, enough = wanted(options.target, picture)
        xy = picture.xy - np.array([left, top], np.float32)
        seen = enough & (xy >= _EDGE_PX).all(axis=1) & (xy < np.array(options.size) - _EDGE_PX).all(axis=1)
        x, y = np.rint(xy[seen]).astype(np.int64).T
        # What becomes of a patch does not depend on its being mirrored.
        if rng.random() < 0.5:
            crop, x = crop[:, ::-1], width - 1 - x
        if rng.random() < 0.5:
            crop, y = crop[::-1], height - 1 - y
        crops.append(crop)
        at.append(np.stack([np.full_like(x, number), y, x], axis=1))
        scores.append(score[seen].astype(np.float32))
    arrays = np.stack(crops)[:, None], np.concatenate(at), np.concatenate(scores)
    return Told(*map(torch.from_numpy, arrays))


def followed_losses(network: KeypointNet, batch: Told, precision: TrainingPrecision = "float32") -> dict[str, Tensor]:
    """Cross entropy of what the network says of points from what became of them."""
    with torch.autocast(batch.crops.device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        said = responses(network, batch.crops / 255.0)
    at, score = tuple(batch.at.T), batch.score
    loss = binary_cross_entropy_with_logits(said[at], score) if len(score) else said.sum() * 0.0
    return {"followed": loss, "total": loss}


def rank_correlation(network: KeypointNet, pictures: Sequence[Followed], target: Target) -> float:
    """How well the network, ready to run, orders the points of an image as the ``target`` does: mean of Spearman's."""
    from scipy.stats import spearmanr

    found = []
    for picture in pictures:
        score, enough = wanted(target, picture)
        image = torch.from_numpy(padded_to_cells(picture.pixels).copy())
        with torch.inference_mode():
            said = responses(network, image[None, None].float() / 255.0)[0].numpy()
        x, y = np.rint(picture.xy[enough]).astype(np.int64).T
        if len(np.unique(score[enough])) > 1:
            found.append(spearmanr(said[y, x], score[enough]).statistic)
    return float(np.mean(found)) if found else float("nan")
