"""Images by themselves: size, darkness, overexposure, blur, texture, and images that repeat."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vioframe.arrays import Bool
from vioframe.diagnosis.findings import Certainty, Finding, Severity
from vioframe.diagnosis.recording import Recording
from vioframe.errors import ImageSizeError
from vioframe.geometry.cameras import Camera
from vioframe.types import NS_PER_S

_DARK, _DARK_CONTRAST, _MOSTLY_BRIGHT = 20.0, 12.0, 0.5
_BLURRED, _MOST_REPEATED = 0.2, 0.03
_FEWEST_TRACKS = 30
_MOVING_RATE = 0.05  # rad/s
_MOST_UNREADABLE, _SAME_SHAPE = 0.02, 0.02


def look_at_images(recording: Recording) -> list[Finding]:
    """What is wrong with the images, and with what can be followed in them."""
    camera = recording.calibration.cameras[0].model
    return [
        *_unreadable(recording),
        *([wrong_size(wrong, camera)] if (wrong := recording.wrong_size) else []),
        *_light(recording),
        *_blur(recording),
        *_repeated(recording),
        *_texture(recording),
    ]


def _unreadable(recording: Recording) -> Iterator[Finding]:
    for kind, whole in (("frame_unreadable", len(recording.look.t_ns)), ("imu_unreadable", len(recording.imu.t_ns))):
        if count := recording.unreadable[kind]:
            share = count / (whole + count)
            what = "images" if kind == "frame_unreadable" else "rows of the IMU"
            yield Finding(
                "unreadable",
                f"{count} {what} ({share:.1%}) cannot be read",
                "copy the recording again, or look at its disk; `vioframe run` names the first of them",
                Severity.WRONG if share > _MOST_UNREADABLE else Severity.WORTH_KNOWING,
                figures={"count": count, "share": share},
            )


def wrong_size(error: ImageSizeError, camera: Camera | None = None) -> Finding:
    """What a reader said of images that do not fit; with the intrinsics of ``camera`` where these can be scaled."""
    (width, height), (given_width, given_height) = error.size, error.calibrated
    across, down = width / given_width, height / given_height
    remedy = "they were cut or are another camera's: name the right --calibration"
    if abs(across / down - 1.0) < _SAME_SHAPE:
        remedy = f"they are {across:.4g} times as large: scale the intrinsics too, or name the right --calibration"
        if camera is not None:
            cx, cy = (camera.cx + 0.5) * across - 0.5, (camera.cy + 0.5) * down - 0.5
            intrinsics = f"[{camera.fx * across:.3f}, {camera.fy * down:.3f}, {cx:.3f}, {cy:.3f}]"
            remedy = (
                f"if they were resized, `intrinsics: {intrinsics}` and `resolution: [{width}, {height}]`; "
                "else name this camera's --calibration"
            )
    return Finding(
        "image_size",
        f"images are {width}x{height}, the calibration is for {given_width}x{given_height}",
        remedy,
        figures={"width_px": width, "height_px": height},
    )


def _light(recording: Recording) -> Iterator[Finding]:
    look = recording.look
    if not np.isfinite(look.brightness).any():
        return
    dark = look.brightness < _DARK
    flat = dark & (look.contrast < _DARK_CONTRAST)
    seen = np.isfinite(look.brightness)
    if (share := float(dark[seen].mean())) > 0.2:
        yield Finding(
            "images_dark",
            f"{share:.0%} of the images are dark, {np.nanmedian(look.brightness):.0f} of 255 in the median",
            "give it more light, exposure or gain",
            Severity.WRONG if float(flat[seen].mean()) > 0.2 else Severity.WORTH_KNOWING,
            figures={"share": share, "brightness": float(np.nanmedian(look.brightness))},
        )
    if (share := float((look.bright_share[seen] > _MOSTLY_BRIGHT).mean())) > 0.2:
        yield Finding(
            "images_bright",
            f"{share:.0%} of the images are overexposed over half of their area",
            "take exposure or gain back",
            figures={"share": share},
        )


def _blur(recording: Recording) -> Iterator[Finding]:
    look = recording.look
    with_edges = np.isfinite(look.sharpness) & (look.contrast > _DARK_CONTRAST)
    if not with_edges.any():
        return
    blurred = look.sharpness[with_edges] < _BLURRED
    if (share := float(blurred.mean())) > 0.2:
        sharpness = float(np.median(look.sharpness[with_edges]))
        yield Finding(
            "images_blurred",
            f"{share:.0%} of the images are blurred: fine detail has {sharpness:.2f} of the contrast that it has at a "
            "quarter of the size",
            "focus the lens, or shorten the exposure",
            certainty=Certainty.LIKELY,
            figures={"share": share, "sharpness": sharpness},
        )


def _repeated(recording: Recording) -> Iterator[Finding]:
    """The same image again while the body turns: at rest, and without noise, two may be alike."""
    look, imu = recording.look, recording.imu.sorted()
    if len(look.t_ns) < 2 or len(imu.t_ns) < 2:
        return
    bias = np.median(imu.gyro_B, axis=0)
    where = look.t_ns + recording.calibration.cameras[0].time_offset_ns
    rates = np.stack([np.interp(where, imu.t_ns, imu.gyro_B[:, axis]) for axis in range(3)], axis=1)
    moving = np.linalg.norm(rates - bias, axis=1) > _MOVING_RATE
    repeated = look.repeated & moving
    share = float(repeated.sum()) / max(int(moving.sum()), 1)
    if share > _MOST_REPEATED and repeated.sum() >= 3:
        longest = _longest_run(repeated)
        first_s = float(look.t_ns[np.flatnonzero(repeated)[0]] - look.t_ns.min()) / NS_PER_S
        yield Finding(
            "images_frozen",
            f"{repeated.sum()} images ({share:.0%}) are the one before once more while the body turns, "
            f"up to {longest} in a row, first after {first_s:.2f} s",
            "see why the camera or its driver repeats them; lower the frame rate to what it can give",
            figures={"repeated": float(repeated.sum()), "share": share, "longest": longest},
        )


def _longest_run(mask: Bool) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0


def _texture(recording: Recording) -> Iterator[Finding]:
    counts = [len(tracks.ids) for stretch in recording.stretches for tracks in stretch]
    if counts and (usual := float(np.median(counts))) < _FEWEST_TRACKS:
        yield Finding(
            "texture",
            f"{usual:.0f} points can be followed in the median image",
            "point the camera at more structure, or give it more light",
            Severity.WRONG if usual < _FEWEST_TRACKS / 2 else Severity.WORTH_KNOWING,
            figures={"points": usual},
        )
