"""Written files take the place of older ones, and of nothing that somebody else has put beside them."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from vioframe.errors import DatasetError


def remove_written(folder: Path, patterns: Iterable[str]) -> None:
    """Take out of ``folder`` the files that match, and the folders that are empty without them, ``folder`` included."""
    within = folder.resolve()
    for old in [file for pattern in patterns for file in folder.glob(pattern)]:
        if old.parent.resolve().is_relative_to(within):  # not what is behind a link to elsewhere
            old.unlink()
            for emptied in (folder / parent for parent in old.relative_to(folder).parents):
                with suppress(OSError):  # that it holds more
                    emptied.rmdir()


@contextmanager
def appearing(destination: Path, *, replace: Sequence[str] | None = None) -> Iterator[Path]:
    """A place of the same name to write to, moved to ``destination`` if all goes well and removed if not.

    ``replace`` allows a destination that exists: a file, or of a folder those files that match one of the patterns;
    what else it holds stays, beside what is new. Raises :class:`~vioframe.errors.DatasetError` where it cannot be
    written, or exists and is not to be replaced.
    """
    if destination.exists() and replace is None:
        raise DatasetError(f"{destination} exists already; remove it or choose another name")
    workspace = destination.with_name(f".{destination.name}.unfinished")
    try:
        shutil.rmtree(workspace, ignore_errors=True)
        workspace.mkdir(parents=True)
        new = workspace / destination.name
        yield new
        if destination.is_dir():
            remove_written(destination, replace or ())
        if destination.is_dir():
            for file in [path for path in new.rglob("*") if path.is_file()]:
                place = destination / file.relative_to(new)
                place.parent.mkdir(parents=True, exist_ok=True)
                file.replace(place)
        else:
            new.replace(destination)
    except (OSError, sqlite3.Error) as err:
        reason = getattr(err, "strerror", None) or err
        raise DatasetError(f"cannot write {destination}: {reason}; check permissions and free space") from err
    finally:
        shutil.rmtree(workspace, ignore_errors=True)
