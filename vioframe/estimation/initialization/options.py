"""What the initialiser asks of the data before it believes itself."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InitializationOptions:
    """Thresholds of both methods. The defaults suit a 20 Hz camera and a MEMS IMU such as EuRoC's."""

    pixel_sigma: float = 1.0
    """Standard deviation of an observation, px."""
    bias_gyro_sigma: float = 0.2
    """Prior of the gyroscope's bias about zero, rad/s."""
    bias_accel_sigma: float = 0.15
    """Prior of the accelerometer's bias about zero, m/s^2."""
    imu_noise_factor: float = 8.0
    """The dynamic method takes all densities of the IMU this many times as large: data sheets are measured at rest, and
    vibration, scale and alignment errors come on top (measured on EuRoC's flights: 4 to 10)."""
    largest_imu_gap_s: float = 0.1
    """A longer stretch without readings begins the window anew."""

    min_second_turn_rad: float = 0.15
    """Turns about other axes than the main one (root of their sum of squares) that the hand-eye calibration needs."""
    max_camera_rotation_sigma_deg: float = 0.4
    """Largest standard deviation of the camera's rotation on the body that is accepted."""

    static_window_s: float = 1.0
    """Length of the standstill that the static method needs."""
    static_gyro_std: float = 0.02
    """Most the gyroscope's mean over 0.1 s may vary at rest, rad/s."""
    static_accel_std: float = 0.2
    """Most the accelerometer's mean over 0.1 s may vary at rest, m/s^2."""
    static_disparity_px: float = 1.5
    """Most the median feature may move between the thirds of the window."""

    shortest_window_s: float = 1.5
    """The dynamic method is first tried when the window is this long, s ..."""
    longest_window_s: float = 3.0
    """... and looks back no farther than this."""
    attempt_interval_s: float = 0.1
    """Time between two attempts of the dynamic method."""
    keyframes: int = 10
    """Frames of the window that are estimated."""
    max_landmarks: int = 100
    """Tracks that are used, the longest first."""
    min_landmarks: int = 20
    """Fewer usable tracks refuse the attempt."""
    min_parallax_px: float = 5.0
    """Least median parallax across the tracks, with the rotation taken out."""
    lookahead_s: float = 0.2
    """Length of the newest part of the window, which is predicted from the rest to test the estimate."""
    max_reprojection_px: float = 2.0
    """Most the observations may disagree with the estimate (RMS) ..."""
    max_lookahead_px: float = 3.0
    """... and the predicted part of the window with its prediction (median)."""
    max_scale_sigma: float = 0.06
    """Largest relative standard deviation of scale that is accepted."""
    max_velocity_sigma: float = 0.05
    """Largest standard deviation of velocity on any axis that is accepted, m/s."""
    max_tilt_sigma_deg: float = 1.0
    """Largest standard deviation of the gravity direction that is accepted."""
