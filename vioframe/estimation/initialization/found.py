"""A calibration that was found to fit while starting, in place of the given one."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vioframe.arrays import Float
from vioframe.estimation.factors.reprojection import INTRINSICS, OFFSET, READOUT, Calibrated
from vioframe.estimation.initialization.window import UnsureError
from vioframe.geometry import so3
from vioframe.types import NS_PER_S, Calibration, CameraSigma

# A part of a calibration that is off by so many standard deviations is clearly wrong.
_CLEAR = 3.0
# Standard deviations with which a start can take a part over, rad, s and relative.
_FOUND_SURE = {"rotation": np.deg2rad(1.5), "offset": 0.012, "focal": 0.02, "readout": 0.005}


@dataclass(frozen=True, slots=True)
class Found:
    """A calibration in place of the given one, and how well the parts that were found are known.

    ``offset_sigma_s`` and ``rotation_sigma`` rad, ``focal_sigma`` relative, ``readout_sigma_s``; None is what was not
    looked for.
    """

    calibration: Calibration
    offset_sigma_s: float | None = None
    rotation_sigma: float | None = None
    focal_sigma: float | None = None
    readout_sigma_s: float | None = None

    def sigma(self, given: CameraSigma, factor: float = 1.0) -> CameraSigma:
        """``given``, where nothing else was found; what was, ``factor`` times as unsure."""
        model = self.calibration.cameras[0].model
        focal = factor * (self.focal_sigma or 0.0) * np.array([model.fx, model.fy, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        return replace(
            given,
            rotation=np.maximum(factor * (self.rotation_sigma or 0.0), given.rotation),
            time_offset_s=max(factor * (self.offset_sigma_s or 0.0), given.time_offset_s),
            intrinsics=np.maximum(focal, given.intrinsics),
            readout_s=factor * (self.readout_sigma_s or 0.0) or given.readout_s,
        )

    def after(self, before: Found | None) -> Found:
        """With what was found ``before`` and not again."""
        if before is None:
            return self
        kept = {name: getattr(before, name) for name in self.__slots__ if getattr(self, name) is None}
        return replace(self, **kept)

    def settled(self, cameras: Calibrated, cov: Float) -> Found:
        """With the parts that were found as an adjustment has them in the end, with covariance (16, 16).

        The time offset stays as the frames have been cut by it; an estimator finds the rest.
        """
        again = ("rotation", self.rotation_sigma), ("focal", self.focal_sigma), ("readout", self.readout_sigma_s)
        parts = {part for part, sigma in again if sigma is not None}
        return _found(self.calibration, cameras, _sigmas(self.calibration, cov), parts).after(self)

    def __str__(self) -> str:
        (camera,), parts = self.calibration.cameras, []
        if self.offset_sigma_s is not None:
            offset_ms = 1e-6 * camera.time_offset_ns
            parts.append(f"time offset {offset_ms:.0f} ms (+- {1e3 * self.offset_sigma_s:.0f} ms)")
        if self.rotation_sigma is not None:
            quat = " ".join(f"{q:.5f}" for q in so3.to_quat_xyzw(camera.R_BC))
            sigma_deg = np.rad2deg(self.rotation_sigma)
            parts.append(f"camera's rotation on the body, R_BC as quat_xyzw {quat} (+- {sigma_deg:.1f} deg)")
        if self.focal_sigma is not None:
            parts.append(f"focal length {camera.model.focal_px:.0f} px (+- {100.0 * self.focal_sigma:.0f} %)")
        if self.readout_sigma_s is not None:
            parts.append(f"readout {1e3 * camera.readout_s:.0f} ms (+- {1e3 * self.readout_sigma_s:.0f} ms)")
        return "found while starting: " + ", ".join(parts)


def found_by(given: Calibration, cameras: Calibrated, cov: Float) -> Found:
    """What of ``cameras``, with covariance (16, 16), differs most from the calibration ``given``, or clearly.

    Raises :class:`UnsureError` where that is not known well enough.
    """
    old = given.cameras[0]
    sigma = _sigmas(given, cov)
    off = {
        "rotation": float(np.linalg.norm(so3.log(old.R_BC.T @ cameras.R_BC[0]))),
        "offset": float(abs(cameras.offset_s[0])),
        "focal": abs(_zoom(given, cameras)),
        "readout": float(abs(cameras.readout_s[0] - old.readout_s)),
    }
    clear = {part: off[part] / max(sigma[part], 1e-12) for part in off}
    chosen = {part for part in clear if clear[part] >= min(_CLEAR, max(clear.values()))}
    if unsure := [part for part in chosen if sigma[part] > _FOUND_SURE[part]]:
        raise UnsureError(
            f"the {' and '.join(unsure)} given contradict what is seen; what fits is not known well enough"
        )
    return _found(given, cameras, sigma, chosen)


def _sigmas(given: Calibration, cov: Float) -> dict[str, float]:
    """How well each part is known by the covariance (16, 16) of its adjustment."""
    model, by_focal = given.cameras[0].model, np.zeros(len(cov))
    by_focal[INTRINSICS][:2] = 0.5 / model.fx, 0.5 / model.fy
    return {
        "rotation": float(np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1])),
        "offset": float(np.sqrt(cov[OFFSET, OFFSET])),
        "focal": float(np.sqrt(by_focal @ cov @ by_focal)),
        "readout": float(np.sqrt(cov[READOUT, READOUT])),
    }


def _zoom(given: Calibration, cameras: Calibrated) -> float:
    """By how much longer the focal length is, relative."""
    model = given.cameras[0].model
    return float(np.mean(cameras.intrinsics[0, :2] / (model.fx, model.fy))) - 1.0


def _found(given: Calibration, cameras: Calibrated, sigma: dict[str, float], parts: Set[str]) -> Found:
    """``given`` with the ``parts`` that are as ``cameras`` have them."""
    old = given.cameras[0]
    changes: dict[str, dict[str, Any]] = {
        "rotation": {"R_BC": cameras.R_BC[0]},
        "offset": {"time_offset_ns": old.time_offset_ns + round(cameras.offset_s[0] * NS_PER_S)},
        "focal": {"model": old.model.zoomed(1.0 + _zoom(given, cameras))},
        "readout": {"readout_s": float(cameras.readout_s[0])},
    }
    return Found(
        given.with_camera(0, **{name: value for part in parts for name, value in changes[part].items()}),
        *(sigma[part] if part in parts else None for part in ("offset", "rotation", "focal", "readout")),
    )
