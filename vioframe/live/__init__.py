"""Live sources: what comes in while the estimator works, recorded, timed, and led on at the rate of the IMU.

source -> Inbox (a thread) -> Odometry -> steps        :class:`Live` is the data set that a source is made into
             readings -> Ahead -> states at 200 Hz
"""

from vioframe.live.stream import Live

__all__ = ["Live"]
