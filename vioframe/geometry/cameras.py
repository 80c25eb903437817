"""Pinhole cameras with radial-tangential or equidistant distortion.

A point on the z = 1 plane (``xy_normalised``) maps to a pixel ``xy`` = (fx u + cx, fy v + cy), where (u, v) is the
distorted point. Pixels are (x, y) with integers at pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vioframe.arrays import Float
from vioframe.errors import CalibrationError

DistortionModel = Literal["radtan", "equidistant"]
_MODELS = get_args(DistortionModel)

# Of an image a side; it is what OpenCV can address.
_MOST_PX = 32_767


@dataclass(frozen=True)
class Camera:
    """``resolution`` is (width, height) px; ``distortion`` k1 k2 p1 p2 (radtan) or k1 k2 k3 k4 (equidistant)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float]
    resolution: tuple[int, int]
    distortion_model: DistortionModel = "radtan"

    def __post_init__(self) -> None:
        if self.distortion_model not in _MODELS:
            raise CalibrationError(f"unknown distortion model {self.distortion_model!r}; use radtan or equidistant")
        numbers = [self.fx, self.fy, self.cx, self.cy, *self.distortion]
        if len(self.distortion) != 4 or not np.all(np.isfinite(numbers)) or self.fx <= 0.0 or self.fy <= 0.0:
            raise CalibrationError(f"camera needs fx, fy > 0 and four finite distortion coefficients, got {numbers}")
        if len(self.resolution) != 2 or not all(1 <= size <= _MOST_PX for size in self.resolution):
            raise CalibrationError(f"camera needs a resolution of (width, height) px, got {self.resolution}")

    @property
    def K(self) -> Float:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def focal_px(self) -> float:
        """Mean focal length, for turning pixels into normalised units."""
        return 0.5 * (self.fx + self.fy)

    def zoomed(self, factor: float) -> Camera:
        """The same with both focal lengths ``factor`` times as long."""
        return replace(self, fx=factor * self.fx, fy=factor * self.fy)

    def shrunk(self, divisor: int) -> Camera:
        """The same of images in which ``divisor`` by ``divisor`` pixels are one."""
        width, height = self.resolution
        return replace(
            self,
            fx=self.fx / divisor,
            fy=self.fy / divisor,
            cx=(self.cx + 0.5) / divisor - 0.5,
            cy=(self.cy + 0.5) / divisor - 0.5,
            resolution=(width // divisor, height // divisor),
        )

    def with_intrinsics(self, intrinsics: Float) -> Camera:
        """The same with ``intrinsics`` (8,): fx fy cx cy and the distortion's coefficients."""
        fx, fy, cx, cy, *distortion = intrinsics.tolist()
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))

    def project(self, p_C: ArrayLike) -> Float:
        """(N, 3) points in the camera frame, z > 0 -> (N, 2) px."""
        p_C = np.asarray(p_C, dtype=np.float64)
        return self.distort(p_C[:, :2] / p_C[:, 2:])

    def distort(self, xy_normalised: ArrayLike) -> Float:
        """(N, 2) undistorted points on the z = 1 plane -> (N, 2) px."""
        from vioframe.geometry.kernels import distorted  # loads numba

        return distorted(*intrinsics_of(self), np.ascontiguousarray(xy_normalised, dtype=np.float64).reshape(-1, 2))

    def undistort(self, xy: ArrayLike) -> Float:
        """(N, 2) px -> (N, 2) undistorted points with z = 1, by Newton's method; the inverse of :meth:`distort`.

        Points so far outside the image that the model cannot be inverted come back as NaN.
        """
        from vioframe.geometry.kernels import undistorted  # loads numba

        return undistorted(*intrinsics_of(self), np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2))

    def contains(self, xy: ArrayLike, border_px: float = 0.0) -> NDArray[np.bool_]:
        """(N,) whether pixels lie in the image, at least ``border_px`` from its outermost pixel centres."""
        xy = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        limit = np.array(self.resolution) - 1.0 - border_px
        return np.asarray(((xy >= border_px) & (xy <= limit)).all(axis=1))


def intrinsics_of(camera: Camera) -> tuple[int, Float]:
    """The camera as :mod:`kernels` takes it: model number and (8,) [fx fy cx cy d1 d2 d3 d4]."""
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    return _MODELS.index(camera.distortion_model), intrinsics
