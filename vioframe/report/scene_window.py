"""A scene in a window that can be turned with the mouse, by Open3D's visualiser."""

from __future__ import annotations

import os
import sys
from ctypes import CDLL, c_char_p, c_void_p
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.errors import RunError
from vioframe.geometry.meshes import import_open3d
from vioframe.report.scene import Scene
from vioframe.report.scene_drawing import draw
from vioframe.report.scene_grid import Grid
from vioframe.report.scene_shapes import Shape
from vioframe.report.scene_view import View

_NO_WINDOW = "no window can be opened here; write a picture instead: --save FILE.png"


def check_display() -> None:
    """Raise :class:`RunError` where no window can be opened.

    Open3D itself would go on without one, and wait for ever for somebody to close it.
    """
    if sys.platform.startswith("linux") and not (_has_wayland() or _has_x11()):
        raise RunError(f"there is no display, so {_NO_WINDOW}")


def show(scene: Scene, grid: Grid, view: View, title: str) -> None:
    """Open a window on ``scene`` as seen in ``view``, and return when it is closed. Raises :class:`RunError`."""
    check_display()
    o3d = import_open3d("vioframe view")
    window = o3d.visualization.Visualizer()
    if not window.create_window(title, *view.size):
        raise RunError(_NO_WINDOW)
    try:
        fill(window, scene, grid, view)
        window.run()
    finally:
        window.destroy_window()


def fill(window: Any, scene: Scene, grid: Grid, view: View) -> None:
    """Put ``scene`` into an Open3D ``Visualizer`` whose window is open, and look at it as in ``view``."""
    drawing = draw(scene, grid, view)
    for shape in (drawing.world, drawing.solid):
        if len(shape.corners):
            window.add_geometry(_mesh(shape))
    options = window.get_render_option()
    options.background_color = np.ones(3)
    # The world's walls face the flight: from behind one looks through them.
    options.mesh_show_back_face = False
    camera = import_open3d("vioframe view").camera.PinholeCameraParameters()
    camera.intrinsic.set_intrinsics(*view.size, view.focal_px, view.focal_px, *view.centre_px)
    T_VW = np.eye(4)
    T_VW[:3, :3], T_VW[:3, 3] = view.R_VW, -view.R_VW @ view.eye
    camera.extrinsic = T_VW
    window.get_view_control().convert_from_pinhole_camera_parameters(camera, allow_arbitrary=True)


def _mesh(shape: Shape) -> Any:
    o3d = import_open3d("vioframe view")
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(shape.corners.reshape(-1, 3)),
        o3d.utility.Vector3iVector(np.arange(3 * len(shape.corners), dtype=np.int32).reshape(-1, 3)),
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.repeat(shape.colour, 3, axis=0))
    mesh.compute_vertex_normals()
    return mesh


def _has_wayland() -> bool:
    name = os.environ.get("WAYLAND_DISPLAY")
    return bool(name) and (Path(os.environ.get("XDG_RUNTIME_DIR", "")) / str(name)).exists()


def _has_x11() -> bool:
    """Whether the display that is named can be reached, too: it may be one of a connection that is gone."""
    library = find_library("X11")
    if not os.environ.get("DISPLAY") or library is None:
        return False
    x11 = CDLL(library)
    x11.XOpenDisplay.restype, x11.XOpenDisplay.argtypes = c_void_p, [c_char_p]
    x11.XCloseDisplay.argtypes = [c_void_p]
    display = x11.XOpenDisplay(None)
    if not display:
        return False
    x11.XCloseDisplay(display)
    return True
