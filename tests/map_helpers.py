"""Boxes to fly in, as meshes."""

from pathlib import Path

import numpy as np


def box(low, high):
    """(12, 3, 3) triangles of an upright box."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    corners = []
    for axis in range(3):
        u, v = np.roll(np.eye(3), -axis, axis=0)[1:] * (high - low)
        for start in (low, low + np.eye(3)[axis] * (high - low)):
            corners += [[start, start + u, start + u + v], [start, start + u + v, start + v]]
    return np.array(corners)


def write_ply_mesh(path: Path, corners: np.ndarray) -> Path:
    """Triangles (T, 3, 3) as the ASCII PLY mesh ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    vertices = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in corners.reshape(-1, 3).tolist())
    faces = "".join(f"3 {i} {i + 1} {i + 2}\n" for i in range(0, 3 * len(corners), 3))
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {3 * len(corners)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(corners)}\nproperty list uchar int vertex_indices\nend_header\n{vertices}{faces}"
    )
    return path
