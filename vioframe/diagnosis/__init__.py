"""What is wrong with a recording, and what to do about it.

    gather -> look at stamps, IMU, images, motion, geometry -> findings, the cause ahead of what follows from it

:func:`diagnose` reads like that; a module each knows one kind of thing. :mod:`vioframe.diagnosis.findings` lists all
kinds of findings.
"""

from vioframe.diagnosis.diagnosis import HOPELESS, Diagnosis, diagnose
from vioframe.diagnosis.findings import CAUSES, Certainty, Finding, Severity
from vioframe.diagnosis.recording import Gatherer, Recording, gather

__all__ = [
    "CAUSES",
    "HOPELESS",
    "Certainty",
    "Diagnosis",
    "Finding",
    "Gatherer",
    "Recording",
    "Severity",
    "diagnose",
    "gather",
]
