"""What went wrong without ending the run: counted here, written to ``summary.json``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

_NOTES_KEPT_PER_KIND = 20


@dataclass
class Incidents:
    """Counts of handled irregularities by kind, with the first few described.

    Kinds are short snake_case names such as ``imu_nan`` or ``detector_failed``.
    """

    counts: Counter[str] = field(default_factory=Counter)
    notes: list[dict[str, object]] = field(default_factory=list)

    def add(self, kind: str, t_ns: int | None = None, detail: str = "") -> None:
        """Count one occurrence of ``kind``; ``detail`` is kept for its first occurrences."""
        self.counts[kind] += 1
        if self.counts[kind] <= _NOTES_KEPT_PER_KIND:
            self.notes.append({"kind": kind, "t_ns": t_ns, "detail": detail})
