"""Whether pushing measurements from Python costs what the command line does, on the same data, to the same bytes.

    python benchmarks/odometry_speed.py [--record] [--rounds N]

Target. The Python example of the README takes within 10 % of the command line's time a frame, and gives the same bytes.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import click
from common import SHARED_DATA, present, script

from vioframe.bench import Row

COLUMNS = {
    "way": "",
    "rounds": "d",
    "frame_ms": ".2f",
    "lowest_ms": ".2f",
    "highest_ms": ".2f",
    "ratio": ".3f",
    "same_bytes": "",
}
# The example of the README, and what it says of each frame written as the command line does.
EXAMPLE = """
import json, sys
import vioframe
from vioframe.io.trajectories import tum_line

dataset = vioframe.open_dataset(sys.argv[1], cameras=["cam0"])
odometry = vioframe.Odometry(dataset.calibration, detector="shi_tomasi", backend="msckf")
lines, seconds, frames = ["# timestamp tx ty tz qx qy qz qw\\n"], 0.0, 0
for measurement in dataset.measurements():
    for step in odometry.add(measurement):
        frames += 1
        seconds += sum(s for stage, s in step.stage_seconds.items() if "." not in stage)
        if step.estimate.status == "tracking":
            lines.append(tum_line(step.frames.t_ns, step.estimate.state.R_WB, step.estimate.state.p_WB))
for step in odometry.finish():
    frames += 1
    lines.append(tum_line(step.frames.t_ns, step.estimate.state.R_WB, step.estimate.state.p_WB))
open(sys.argv[2], "w", newline="\\n").writelines(lines)
print(json.dumps(1e3 * seconds / frames))
"""


@script
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
@click.option("--rounds", default=5, show_default=True, help="Runs of each, in turn.")
@click.option("--data", type=click.Path(exists=True, path_type=Path), default=SHARED_DATA / "euroc/MH_01_easy_15s")
def main(keep: bool, rounds: int, data: Path) -> None:
    """The command line and the README's Python example on the same data."""
    present(
        "odometry_speed",
        "pushing from Python",
        _rows(data, rounds),
        COLUMNS,
        {"rounds": rounds, "data": data.name},
        keep,
    )


def _rows(data: Path, rounds: int) -> Iterator[Row]:
    by_command, by_example, same = [], [], True
    with TemporaryDirectory() as folder:
        run, pushed = Path(folder) / "run", Path(folder) / "pushed.tum"
        for _ in range(rounds):
            command = ["-m", "vioframe", "run", str(data), "--quiet", "--overwrite", "--out", str(run)]
            subprocess.run([sys.executable, *command], check=True)
            by_command.append(json.loads((run / "summary.json").read_text())["mean_frame_ms"])
            done = subprocess.run(
                [sys.executable, "-c", EXAMPLE, str(data), str(pushed)], check=True, capture_output=True, text=True
            )
            by_example.append(json.loads(done.stdout))
            same &= pushed.read_bytes() == (run / "trajectory.tum").read_bytes()
    for way, times in (("command line", by_command), ("Odometry", by_example)):
        yield {
            "way": way,
            "rounds": rounds,
            "frame_ms": median(times),
            "lowest_ms": min(times),
            "highest_ms": max(times),
            "ratio": median(b / a for a, b in zip(by_command, times, strict=True)),
            "same_bytes": "yes" if same else "no",
        }


if __name__ == "__main__":
    main()
