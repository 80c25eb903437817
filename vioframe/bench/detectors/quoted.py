"""What was published about detectors' speed: quoted, never measured here."""

from __future__ import annotations

from dataclasses import dataclass

FROM_PAPER = "quoted in the thesis from another paper, hardware not stated"
FROM_THESIS = "thesis, on its own machine, KeypointNet being the full network on a GPU"


@dataclass(frozen=True, slots=True)
class QuotedSpeed:
    """A row of the thesis' Table 3.2: frames per second at 480 x 640 and 300 keypoints, and where it stems from."""

    title: str
    fps: float
    source: str


TABLE_3_2 = {
    "orb": QuotedSpeed("ORB", 33.0, FROM_PAPER),
    "sift": QuotedSpeed("SIFT", 12.0, FROM_PAPER),
    "surf": QuotedSpeed("SURF", 10.0, FROM_PAPER),
    "akaze": QuotedSpeed("AKAZE", 18.0, FROM_PAPER),
    "brisk": QuotedSpeed("BRISK", 5.0, FROM_PAPER),
    "superpoint": QuotedSpeed("SuperPoint", 67.0, FROM_PAPER),
    "lf_net": QuotedSpeed("LF-Net", 25.0, FROM_PAPER),
    "unsuperpoint": QuotedSpeed("UnsuperPoint", 65.0, FROM_PAPER),
    "shi_tomasi": QuotedSpeed("Shi-Tomasi", 160.0, FROM_THESIS),
    "keypointnet": QuotedSpeed("KeypointNet", 184.0, FROM_THESIS),
}
"""By the name of the detector's plug-in, or what it would be called."""
