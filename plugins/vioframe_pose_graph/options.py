"""The options of the loop closer, with settings that serve rooms and halls."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphOptions:
    """Lengths and angles of drift are what an odometry is trusted with, not what it is hoped to reach."""

    parallax_px: float = 20.0
    """Image motion, turning left out, after which a frame becomes the next keyframe."""
    max_corners: int = 600
    """Corners described in a keyframe beside the tracked features."""
    min_gap_s: float = 10.0
    """A place seen less long ago than this is not looked for: the odometry still knows it."""
    max_candidates: int = 3
    """Earlier places that each keyframe is compared with in detail."""
    reprojection_px: float = 3.0
    """Distance, px, within which a point of one keyframe must be seen in the other to support a loop."""
    min_inliers: int = 25
    """Points that must support a loop."""
    position_drift: float = 0.03
    """Drift of the odometry's position, m after 1 m; it grows with the square root of the way."""
    yaw_drift_deg: float = 0.2
    """Drift of the odometry's yaw, deg after 1 s; it grows with the square root of the time."""

    def __post_init__(self) -> None:
        if self.max_corners < 1 or self.max_candidates < 1 or self.min_inliers < 4:
            raise ValueError("needs max_corners >= 1, max_candidates >= 1, min_inliers >= 4")
        if not (self.parallax_px > 0.0 and self.min_gap_s > 0.0 and self.reprojection_px > 0.0):
            raise ValueError("needs parallax_px > 0, min_gap_s > 0 and reprojection_px > 0")
        if not (self.position_drift > 0.0 and self.yaw_drift_deg > 0.0):
            raise ValueError("needs position_drift > 0 and yaw_drift_deg > 0")
