"""Milliseconds a frame of whole runs by one camera, on one core and on two, against a yardstick of the same minutes.

    python benchmarks/speed.py [--record] [--rounds 5] [--against CHECKOUT]

The yardstick is what OpenCV alone takes for such a front-end on the same images: decoding, equalising, following points
there and back, new points, the essential matrix (``yardstick.py``). On two cores it is two of them at once, which know
nothing of each other: no more can be had of this machine's second core. Everything takes its turn in each round, so
that ratios hold where times do not; all figures are medians over the rounds. Frames a second are by the clock on the
wall, from the first frame to the last, whoever is waited for. ``--against`` has another checkout of vioframe, such as
that of a release, take part.

Targets: on two cores 1.6 times the frames a second of one; the first frame within 0.7 s; the window 5 times faster
than real time, decoding and recording included.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from shutil import rmtree
from statistics import median
from tempfile import TemporaryDirectory
from time import monotonic, sleep

import click
from common import HERE, SHARED_DATA, present, script

from vioframe.bench import Row
from vioframe.parts import registry
from vioframe.parts.config import parse_part

COLUMNS = {
    "data": "",
    "run": "",
    "cores": "d",
    "rounds": "d",
    "frame_ms": ".2f",
    "lowest_ms": ".2f",
    "highest_ms": ".2f",
    "by_yardstick": ".2f",
    "frames_s": ".1f",
    "real_time": ".2f",
    "first_s": ".2f",
    "ratio": ".2f",
}
RUNS = ("shi_tomasi+msckf", "shi_tomasi+sliding_window", "keypointnet+msckf")
_FLIGHT, _FLIGHT_S = "figure_eight", 20
_POLL_S = 0.005
_OF_A_RUN = ("frames_s", "real_time", "first_s")


@script
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
@click.option("--rounds", default=5, show_default=True, help="Runs of each, in turn.")
@click.option(
    "--run", "runs", multiple=True, default=RUNS, show_default=True, metavar="DETECTOR[:KEY=VALUE,...]+BACKEND"
)
@click.option("--against", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="CHECKOUT")
@click.option("--data", type=click.Path(exists=True, path_type=Path), default=SHARED_DATA / "euroc/MH_01_easy_15s")
def main(keep: bool, rounds: int, runs: tuple[str, ...], against: Path | None, data: Path) -> None:
    """Whole runs on DATA and on a rendered flight, on one core and on two."""
    with TemporaryDirectory() as folder:
        flight = Path(folder) / f"{_FLIGHT}.bag"
        options = ["--flight", _FLIGHT, "--duration", str(_FLIGHT_S), "--quiet"]
        subprocess.run([sys.executable, "-m", "vioframe", "simulate", str(flight), *options], check=True)
        settings = {"rounds": rounds, "runs": list(runs), "against": None if against is None else _commit(against)}
        rows = (row for recording in (data, flight) for row in _rows(recording, runs, rounds, against, Path(folder)))
        present("speed", "whole runs", rows, COLUMNS, settings, keep)


def _rows(data: Path, runs: tuple[str, ...], rounds: int, against: Path | None, folder: Path) -> Iterator[Row]:
    """A row for the yardstick and for each run, code and number of cores."""
    measured: dict[tuple[str, Path | None, int], list[Row]] = defaultdict(list)
    for _ in range(rounds):
        for cores in (1, 2):
            measured["yardstick", None, cores].append(_yardstick(data, cores))
        for run in runs:
            for checkout in (None, against) if against else (None,):
                for cores in (1, 2):
                    if checkout is None or cores == 1:
                        measured[run, checkout, cores].append(_run(data, run, checkout, cores, folder / "run"))
    yardstick = measured["yardstick", None, 1]
    for (run, checkout, cores), found in measured.items():
        times = [each["frame_ms"] for each in found]
        row: Row = {
            "data": data.name,
            "run": f"{run} ({_commit(checkout)})" if checkout else run,
            "cores": cores,
            "rounds": rounds,
            "frame_ms": median(times),
            "lowest_ms": min(times),
            "highest_ms": max(times),
            "by_yardstick": median(a["frame_ms"] / b["frame_ms"] for a, b in zip(found, yardstick, strict=True)),
        }
        row |= {name: median(each[name] for each in found) for name in _OF_A_RUN if name in found[0]}
        if stages := found[0].get("stage_ms"):
            row["stage_ms"] = {stage: median(each["stage_ms"].get(stage, 0.0) for each in found) for stage in stages}
        # Frames a second over those on one core; another checkout's milliseconds a frame in these.
        if cores == 2:
            row["ratio"] = _ratio(found, measured[run, None, 1], "frames_s")
        elif checkout is None and against is not None and (run, against, 1) in measured:
            row["ratio"] = _ratio(found, measured[run, against, 1], "frame_ms")
        yield row


def _ratio(found: list[Row], others: list[Row], name: str) -> float:
    return median(float(a[name]) / float(b[name]) for a, b in zip(found, others, strict=True))


def _yardstick(data: Path, copies: int) -> Row:
    """So many at once, each on a core of its own: their mean time, and the frames a second of all."""
    command = [sys.executable, str(HERE / "yardstick.py"), str(data)]
    begun = [on_cores(command, 1, {}, first_core=core) for core in range(copies)]
    frames_s = sum(1e3 / float(each.communicate()[0]) for each in begun)
    return {"frame_ms": 1e3 * copies / frames_s, "frames_s": frames_s}


def _run(data: Path, run: str, checkout: Path | None, cores: int, out: Path) -> Row:
    """One run of the command line, by the code of ``checkout``."""
    spec, backend = run.split("+")
    detector = parse_part(spec, registry.DETECTOR, registry.load())
    command = [sys.executable, "-m", "vioframe", "run", str(data), "--detector", detector.name, "--backend", backend]
    for key, value in detector.options.items():
        command += ["-o", f"detector.{key}={value}"]
    command += ["-o", "cameras=cam0", "--quiet", "--out", str(out)]
    code = {}
    if checkout is not None:  # its own, though another vioframe may lie in the folder that this was begun in
        code = {"PYTHONPATH": f"{checkout}{os.pathsep}{checkout / 'plugins'}", "PYTHONSAFEPATH": "1"}
    rmtree(out, ignore_errors=True)
    first_s, last_s = first_and_last_frame_s(command, cores, out, code)
    summary = json.loads((out / "summary.json").read_text())
    return {
        "frame_ms": summary["mean_frame_ms"],
        "stage_ms": summary["mean_ms"],
        "frames_s": (summary["frames"] - 1) / (last_s - first_s),
        "real_time": summary["real_time_factor"],
        "first_s": first_s,
    }


def first_and_last_frame_s(
    command: list[str], cores: int, out: Path, environment: dict[str, str]
) -> tuple[float, float]:
    """Have ``command`` write the run folder ``out``; how long it took until its first frame was there, and its last."""
    begin_s, frames, came_s = monotonic(), 0, list[float]()
    process = on_cores(command, cores, environment)
    while process.poll() is None:
        if (by_now := _lines(out / "timings.csv") - 1) > frames:
            frames = by_now
            came_s.append(monotonic() - begin_s)
        sleep(_POLL_S)
    if process.wait() != 0 or not came_s:
        raise click.ClickException(f"{' '.join(command)} failed")
    return came_s[0], came_s[-1]


def _lines(path: Path) -> int:
    try:
        return path.read_bytes().count(b"\n")
    except FileNotFoundError:
        return 0


def on_cores(
    command: list[str], cores: int, environment: dict[str, str], first_core: int = 0, stderr: int | None = None
) -> subprocess.Popen[bytes]:
    """Begin ``command`` where it may use so many cores, and its BLAS one.

    Python keeps its byte code, as it does once installed: without, each run begins by compiling all of vioframe anew.
    """
    some = sorted(os.sched_getaffinity(0))[first_core : first_core + cores]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=stderr,
        env={**kept, **one, **environment},
        preexec_fn=partial(os.sched_setaffinity, 0, some),
    )


def _commit(checkout: Path) -> str:
    command = ["git", "-C", str(checkout), "rev-parse", "--short=8", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main()
