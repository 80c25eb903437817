"""The options of the loop closer, with settings that serve rooms and halls."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphOptions:
    """Lengths and angles of drift are the most that an odometry is suspected of, not what it is hoped to reach.

    By them loops are judged, so that twins of a place are told from it. What is believed is weighed by what the
    odometry says itself.
    """

    parallax_px: float = 20.0
    """Image motion, turning left out, after which a frame becomes the next keyframe."""
    max_corners: int = 600
    """Corners described in a keyframe beside the tracked features."""
    min_gap_s: float = 10.0
    """A place seen less long ago than this is not looked for: the odometry still knows it."""
    min_inliers: int = 25
    """Points that must support a loop."""
    overconfidence: float = 3.0
    """How many times as far as its covariance says the odometry may drift; filters know too little of what they do not
    know."""
    position_drift: float = 0.03
    """More that the odometry's position may drift by, m after 1 m; it grows with the square root of the way."""
    yaw_drift_deg: float = 0.2
    """More that the odometry's yaw may drift by, deg after 1 s; it grows with the square root of the time."""

    def __post_init__(self) -> None:
        if self.max_corners < 1 or self.min_inliers < 4:
            raise ValueError("needs max_corners >= 1 and min_inliers >= 4")
        if not self.overconfidence >= 0.0:
            raise ValueError(f"needs overconfidence >= 0, got {self.overconfidence:g}")
        for name in ("parallax_px", "min_gap_s", "position_drift", "yaw_drift_deg"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"needs {name} > 0, got {getattr(self, name):g}")
