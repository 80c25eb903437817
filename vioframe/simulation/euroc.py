"""The calibration of EuRoC's left camera and IMU, as published: the sensor that flights are simulated with."""

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.types import Calibration, ImuNoise

EUROC_CALIBRATION = Calibration(
    camera=Camera(
        fx=458.654,
        fy=457.296,
        cx=367.215,
        cy=248.375,
        distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        resolution=(752, 480),
    ),
    # Published to 12 digits, which is not quite a rotation.
    R_BC=so3.project(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    ),
    p_BC=np.array([-0.0216401454975, -0.064676986768, 0.00981073058949]),
    imu=ImuNoise(gyro_density=1.6968e-4, accel_density=2.0e-3, gyro_walk=1.9393e-5, accel_walk=3.0e-3, rate_hz=200.0),
)
