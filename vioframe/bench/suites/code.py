"""The version of the code that a result comes from: every source file that could have had a part in it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from vioframe.parts.registry import Registry
from vioframe.runs import machine

# They read results and make none.
_NO_PART = (("cli",), ("report", "suite"))
_ENDINGS = (".py", ".yaml")


def code_version(installed: Registry) -> str:
    """A digest of vioframe, of every installed plug-in, and of the versions of what they are built on."""
    modules = {part.source.module.partition(".")[0] for table in installed.parts.values() for part in table.values()}
    return _digest(tuple(sorted(modules)))


@cache
def _digest(modules: tuple[str, ...]) -> str:
    digest = hashlib.sha256(repr(sorted(machine.versions().items())).encode())
    for path in [*_framework(), *(path for module in modules for path in _files_of(module))]:
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _framework() -> Iterator[Path]:
    root = Path(__file__).parents[2]
    for path in sorted(root.rglob("*")):
        parts = path.relative_to(root).parts
        if path.suffix in _ENDINGS and not any(parts[: len(none)] == none for none in _NO_PART):
            yield path


def _files_of(module: str) -> list[Path]:
    """The source of a plug-in, and the data beside it where it is a package."""
    spec = find_spec(module)
    if spec is None:
        return []
    folders = [Path(each) for each in spec.submodule_search_locations or ()]
    if not folders:
        return [Path(spec.origin)] if spec.origin else []
    return sorted(p for folder in folders for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts)
