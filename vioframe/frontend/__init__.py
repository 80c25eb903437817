"""The front-end: images and inertial segments in, feature tracks out.

:class:`Frontend` (tracker.py) is the recipe; flow.py follows points from one image to the next, refill.py decides which
new ones to take. Outlier rejection is in :mod:`vioframe.geometry.two_point` and
:mod:`vioframe.geometry.two_view`.
"""

from vioframe.frontend.options import FrontendOptions
from vioframe.frontend.tracker import Frontend

__all__ = ["Frontend", "FrontendOptions"]
