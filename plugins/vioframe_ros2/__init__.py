"""``ros2:`` and ``ros2:tcp/HOST:PORT``, topics of a running ROS 2 system through Zenoh; ROS itself is not needed.

Read are the topics of nodes under ``RMW_IMPLEMENTATION=rmw_zenoh_cpp``, whose router (``ros2 run rmw_zenoh_cpp
rmw_zenohd``) listens at ``tcp/localhost:7447`` unless it is told otherwise, and those that the bridge of
zenoh-plugin-ros2dds brings from a DDS system. Images are ``sensor_msgs/Image`` or ``CompressedImage``, readings
``sensor_msgs/Imu``. What the nodes say of themselves tells which topics there are; without that, what comes does.

The calibration is the option ``calibration``, or else what is published: each camera's ``camera_info``, and from
``/tf_static`` how cameras and IMU sit on each other. The noise of the IMU, which no message tells, is then that of an
IMU as phones and small cameras have them; ``calibration`` may name a file of the IMU alone.

Where the body is goes back at up to 200 Hz to nodes under rmw_zenoh_cpp, not through the bridge: as
``nav_msgs/Odometry`` on ``/vioframe/odometry`` and as a transform on ``/tf``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from vioframe.errors import needs
from vioframe.io.images import check_bit_depth
from vioframe.parts.hooks import hookimpl

if TYPE_CHECKING:
    from vioframe.interfaces import Source, SourceFactory


def ros2(
    address: str,
    *,
    domain: Annotated[
        int | None, Field(ge=0, le=232, description="ROS_DOMAIN_ID; by default that of the environment, or 0")
    ] = None,
    cameras: Annotated[
        list[str] | str | None, "cameras to use, by name, by topic or as NAME:TOPIC; by default all image topics"
    ] = None,
    imu_topic: Annotated[str | None, "IMU topic; by default the first"] = None,
    calibration: Annotated[
        list[Path] | Path | None, "calibration files or folder, in place of what is published; or the IMU's alone"
    ] = None,
    bit_depth: Annotated[int | None, "bits in use in 16-bit images, 8 to 16"] = None,
    tf: Annotated[bool, "publish the pose as a transform on /tf too"] = True,
    wait_s: Annotated[
        float, Field(gt=0.0, le=3600.0, description="how long topics and their calibration are waited for, s")
    ] = 10.0,
) -> Source:
    """Cameras and an IMU on the topics of a running ROS 2 system, by way of Zenoh."""
    check_bit_depth(bit_depth)
    with needs("eclipse-zenoh", "ros2", user="source 'ros2'"):
        import zenoh  # noqa: F401
    from vioframe_ros2.discovery import Wanted
    from vioframe_ros2.source import Ros2Source

    names = [cameras] if isinstance(cameras, str) else cameras
    files = [calibration] if isinstance(calibration, Path) else calibration or []
    return Ros2Source(address, domain, Wanted(names, imu_topic, files, wait_s), bit_depth=bit_depth, with_tf=tf)


@hookimpl
def vioframe_sources() -> Mapping[str, SourceFactory]:
    return {"ros2": ros2}
