"""Whether a change of the code left the estimates alone: the same flights before and after, byte for byte.

    python benchmarks/same_estimates.py fly OUT --recording NAME=DATA ... [--vioframe COMMAND]
    python benchmarks/same_estimates.py compare BEFORE AFTER

``fly`` runs detectors x back-ends x recordings by the command line and keeps their run folders; ``--vioframe`` is the
command of another checkout. ``compare`` holds the trajectories of two such folders against each other: equal to the
byte, or with the ATE before and after. It exits with 1 where any differs.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from itertools import product
from pathlib import Path

import click

DETECTORS = ("shi_tomasi", "orb", "keypointnet")
BACKENDS = ("msckf", "sliding_window", "loose_ekf")
FILES = ("trajectory.tum", "trajectory_loop.tum")


@click.group()
def main() -> None:
    """Fly before and after a change, and compare."""


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--recording", "recordings", multiple=True, required=True, metavar="NAME=DATA")
@click.option("--vioframe", default=f"{sys.executable} -m vioframe", show_default=True)
def fly(out: Path, recordings: tuple[str, ...], vioframe: str) -> None:
    """Run everything on each recording into OUT/NAME_DETECTOR_BACKEND; what is there already is kept."""
    for recording, detector, backend in product(recordings, DETECTORS, BACKENDS):
        name, _, data = recording.partition("=")
        folder = out / f"{name}_{detector}_{backend}"
        if folder.exists():
            continue
        arguments = ["run", data, "--detector", detector, "--backend", backend, "--loop-closure", "pose_graph"]
        command = [*shlex.split(vioframe), *arguments, "--quiet", "--out", str(folder)]
        code = subprocess.run(command, check=False).returncode
        click.echo(f"{folder.name}: exit code {code}")


@main.command()
@click.argument("before", type=click.Path(path_type=Path, exists=True))
@click.argument("after", type=click.Path(path_type=Path, exists=True))
def compare(before: Path, after: Path) -> None:
    """One line a trajectory; exits with 1 where any differs."""
    differ = 0
    for folder in sorted(path for path in before.iterdir() if path.is_dir()):
        for name in FILES:
            old, new = (root / folder.name / name for root in (before, after))
            if not old.exists():
                continue
            same = new.exists() and old.read_bytes() == new.read_bytes()
            differ += not same
            click.echo(f"{folder.name}/{name}: " + ("identical" if same else _difference(old, new)))
    click.echo(f"{differ} differ")
    sys.exit(differ > 0)


def _difference(old: Path, new: Path) -> str:
    if not new.exists():
        return "is missing"
    truth = old.parent / "ground_truth.tum"
    return f"differs; ATE {_ate_mm(old, truth)} before, {_ate_mm(new, truth)} after"


def _ate_mm(estimate: Path, truth: Path) -> str:
    from vioframe.evaluation import evaluate
    from vioframe.io.trajectories import load_trajectory

    if not truth.exists() or len(estimate.read_text(encoding="utf-8").splitlines()) < 4:
        return "not known"
    return f"{1e3 * evaluate(load_trajectory(estimate), load_trajectory(truth)).ate_m.rmse:.3f} mm"


if __name__ == "__main__":
    main()
