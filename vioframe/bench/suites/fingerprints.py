"""What a result depends on, as digests: the code that made it, its configuration, and the data that it was made of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from vioframe.io.calibration import sidecar_folder
from vioframe.parts.registry import Registry
from vioframe.runs import machine

# They read results and make none.
_READERS = ("cli", "report")
_SAMPLE_BYTES = 1 << 20


def of_values(*values: Any) -> str:
    """Tells plain values from others."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]


def of_code(installed: Registry) -> str:
    """Tells vioframe, all installed plug-ins, and the versions of what they are built on from others."""
    modules = {part.origin.module.partition(".")[0] for table in installed.parts.values() for part in table.values()}
    return _of_modules(("vioframe", *sorted(modules)))


@cache
def _of_modules(modules: tuple[str, ...]) -> str:
    digest = hashlib.sha256(repr(sorted(machine.versions().items())).encode())
    for path in (path for module in modules for path in _sources_of(module)):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _sources_of(module: str) -> list[Path]:
    """The source of a module, and the data beside it where it is a package."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        return []
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    inside = sorted(path for folder in folders for path in folder.rglob("*") if _is_code(path, folder))
    return inside or [Path(spec.origin)]


def _is_code(path: Path, package: Path) -> bool:
    within = path.relative_to(package).parts
    return path.is_file() and within[0] not in _READERS and "__pycache__" not in within


def of_recordings(paths: Iterable[Path], *values: Any) -> str:
    """Of recordings with the calibration beside them: names, sizes and samples of the bytes; and of plain values."""
    digest = hashlib.sha256(of_values(*values).encode())
    for path in (file for each in paths for place in (each, sidecar_folder(each)) for file in _files_of(place)):
        size = path.stat().st_size
        digest.update(f"{path.name} {size}\n".encode())
        with path.open("rb") as file:
            for at in (0, size // 2, max(size - _SAMPLE_BYTES, 0)):
                file.seek(at)
                digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()[:16]


def _files_of(recording: Path) -> list[Path]:
    """The files that tell a recording; none where there is nothing."""
    if recording.is_file():
        return [recording]
    # Thousands of images: the list of their stamps, and the readings, tell the sequence as well.
    return sorted(p for p in recording.rglob("*") if p.is_file() and p.suffix not in (".png", ".jpg"))
