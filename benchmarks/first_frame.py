"""What `vioframe run` waits for before its first frame: imports, by package, and the rest.

    python benchmarks/first_frame.py [--record] [--rounds 9]

The times until the first frame are those of runs by one core and by two; what each package's modules take to import
in such a run on one core is what Python says of it (``-X importtime``), which makes them some tenth longer.
Kernels have been compiled before, and Python keeps its byte code.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from shutil import rmtree
from statistics import median
from tempfile import TemporaryDirectory

import click
from common import SHARED_DATA, present, script
from speed import first_and_last_frame_s, on_cores

from vioframe.bench import Row

COLUMNS = {"what": "", "rounds": "d", "seconds": ".3f", "lowest_s": ".3f", "highest_s": ".3f"}
_IMPORTED = re.compile(r"^import time:\s*(\d+) \|\s*\d+ \|\s*([\w.]+)$", re.MULTILINE)
# Of what others are a part, or are imported for; all else is Python's own, or too little to be told.
_PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "numba": "numba",
    "llvmlite": "numba",
    "pydantic": "pydantic",
    "pydantic_core": "pydantic",
    "annotated_types": "pydantic",
    "cv2": "OpenCV",
    "vioframe": "vioframe",
}


@script
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
@click.option("--rounds", default=9, show_default=True, help="Runs of each, in turn.")
@click.option("--data", type=click.Path(exists=True, path_type=Path), default=SHARED_DATA / "euroc/MH_01_easy_15s")
def main(keep: bool, rounds: int, data: Path) -> None:
    """Time until the first frame of DATA, on one core and on two, and what is imported meanwhile."""
    with TemporaryDirectory() as folder:
        rows = _rows(data, rounds, Path(folder) / "run")
        present("first_frame", "first frame", rows, COLUMNS, {"rounds": rounds, "data": data.name}, keep)


def _rows(data: Path, rounds: int, out: Path) -> Iterator[Row]:
    arguments = ["-m", "vioframe", "run", str(data), "--duration", "3", "--out", str(out), "--quiet"]
    arguments += ["-o", "cameras=cam0"]
    measured: defaultdict[str, list[float]] = defaultdict(list)
    for k in range(rounds + 1):  # the first writes byte code and is left out
        found: defaultdict[str, float] = defaultdict(float)
        for cores in (1, 2):
            rmtree(out, ignore_errors=True)
            first_s, _ = first_and_last_frame_s([sys.executable, *arguments], cores, out, {})
            found[f"until the first frame, {cores} core{'s' * (cores > 1)}"] = first_s
        rmtree(out, ignore_errors=True)
        listed = on_cores([sys.executable, "-X", "importtime", *arguments], 1, {}, stderr=subprocess.PIPE)
        for microseconds, module in _IMPORTED.findall(listed.communicate()[1].decode()):
            package = module.partition(".")[0]
            what = "vioframe" if package.startswith("vioframe_") else _PACKAGES.get(package, "all else")
            found[f"to import: {what}"] += 1e-6 * int(microseconds)
        if k:
            for what, seconds in found.items():
                measured[what].append(seconds)
    for what, times in measured.items():
        yield {
            "what": what,
            "rounds": rounds,
            "seconds": median(times),
            "lowest_s": min(times),
            "highest_s": max(times),
        }


if __name__ == "__main__":
    main()
