"""What a run was made on: software versions, source revision, processor and threads."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import Any


def describe() -> dict[str, Any]:
    """Facts about this machine and installation, as plain values for ``machine.json``."""
    return {
        "vioframe": version("vioframe"),
        "commit": commit(Path(__file__).parent),
        "python": platform.python_version(),
        "versions": versions(),
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "cpu_count": os.cpu_count(),
        "memory_gib": memory_gib(),
        "threads": threads(),
    }


def versions() -> dict[str, str]:
    """Of what vioframe is built on, as far as it is installed."""
    found = {}
    for requirement in requires("vioframe") or []:
        dependency = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        with suppress(PackageNotFoundError):  # of an extra
            facts = metadata(dependency)  # each look at them reads a file
            found[facts["Name"]] = facts["Version"]
    return dict(sorted(found.items()))


def commit(folder: Path) -> str | None:
    """The revision of the repository that tracks ``folder``, ``-dirty`` where it was changed since; else None."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout.strip()

    try:
        # Installed below somebody else's repository, that one's revision would say nothing about this code.
        git("ls-files", "--error-unmatch", "__init__.py")
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None


def cpu_model() -> str:
    """The processor's name as the system tells it."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else platform.processor() or platform.machine()


def memory_gib() -> float | None:
    """Physical memory, or None where the system does not tell."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, OSError, ValueError):
        return None


def threads() -> dict[str, int]:
    """Threads that OpenCV and each loaded BLAS or OpenMP library may use now."""
    import cv2
    from threadpoolctl import threadpool_info

    pools = {Path(pool["filepath"]).name: pool["num_threads"] for pool in threadpool_info()}
    return {"opencv": cv2.getNumThreads(), **dict(sorted(pools.items()))}
