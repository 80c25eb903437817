"""Images of several cameras at one instant, as they come one by one."""

from __future__ import annotations

from collections.abc import Iterator

from vioframe.types import FrameSet


class Pairing:
    """Joins images of one stamp; a partner is waited for until a camera of the set brings its next image, no longer.

    Each camera's images come in order: one that has brought a later image brings none of an earlier stamp any more.
    """

    def __init__(self, count: int) -> None:
        self._newest_ns: list[int | None] = [None] * count
        self._waiting: dict[int, FrameSet] = {}

    def add(self, frames: FrameSet) -> Iterator[FrameSet]:
        """Take the image of one camera; the sets that are complete by it, or not waited for any more, by stamp."""
        place = next(i for i, image in enumerate(frames.images) if image is not None)
        other = self._waiting.get(frames.t_ns)
        if other is not None and other.images[place] is not None:
            yield from self.rest()  # the same stamp twice
            other = None
        if other is not None:
            images = (
                one if one is not None else another for one, another in zip(other.images, frames.images, strict=True)
            )
            frames = FrameSet(frames.t_ns, tuple(images))
        self._waiting[frames.t_ns] = frames
        self._newest_ns[place] = frames.t_ns
        for t_ns in sorted(self._waiting):
            if not self._may_grow(self._waiting[t_ns]):
                yield self._waiting.pop(t_ns)

    def rest(self) -> Iterator[FrameSet]:
        """What still waits."""
        waiting, self._waiting = self._waiting, {}
        yield from (waiting[t_ns] for t_ns in sorted(waiting))

    def _may_grow(self, frames: FrameSet) -> bool:
        """Whether nobody of the set has gone on by now, and somebody else has not come as far."""
        pairs = list(zip(frames.images, self._newest_ns, strict=True))
        went_on = any(image is not None and newest_ns != frames.t_ns for image, newest_ns in pairs)
        awaited = any(image is None and (newest_ns is None or newest_ns < frames.t_ns) for image, newest_ns in pairs)
        return awaited and not went_on
