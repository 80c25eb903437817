"""Files that one process holds at a time; the system lets go of them when it ends, however it does."""

from __future__ import annotations

from pathlib import Path
from typing import IO


def locked(path: Path, *, wait: bool) -> IO[str]:
    """Hold ``path``, a file that is made where there is none, until what is returned is closed.

    Raises :class:`BlockingIOError` where another process holds it and one is not to ``wait``, and :class:`OSError`
    where the file cannot be made. On Windows nothing is held.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("w")
    try:
        import fcntl
    except ImportError:
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BaseException:
        file.close()
        raise
    return file
