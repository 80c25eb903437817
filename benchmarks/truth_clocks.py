"""By how much the positions of EuRoC's ground truth are late by the clock of the IMU, and what of an ATE that is.

    python benchmarks/truth_clocks.py [--record]

Positions are a laser tracker's or a motion capture's, by a clock of its own. How late it is is found without camera and
estimator, by ``position_clock.py``.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from common import SHARED_DATA, present, script
from euroc_clips import run
from position_clock import position_clock, with_positions_of_later

from vioframe.bench import Row
from vioframe.evaluation import evaluate
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.runs.folder import RunFolder
from vioframe.simulation.scenario import load_euroc

COLUMNS = {
    "recording": "",
    "late_ms": ".1f",
    "sigma_ms": ".1f",
    "speed_m_s": ".2f",
    "msckf.ate_mm": ".1f",
    "msckf.on_time_mm": ".1f",
    "sliding_window.ate_mm": ".1f",
    "sliding_window.on_time_mm": ".1f",
}
_CLIP, _FLIGHTS = "euroc/MH_01_easy_15s", "euroc_imu_gt"
_BACKENDS = ("msckf", "sliding_window")


@script
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
@click.option("--data", type=click.Path(exists=True, path_type=Path), default=SHARED_DATA)
def main(keep: bool, data: Path) -> None:
    """Every recording with a ground truth; the one with images is flown, by one camera with Shi-Tomasi's points."""
    flights = sorted(path for path in (data / _FLIGHTS).iterdir() if not path.name.startswith("calib"))
    rows = (_row(path) for path in (data / _CLIP, *flights))
    present("truth_clocks", "positions of the truth by the IMU's clock", rows, COLUMNS, {}, keep)


def _row(path: Path) -> Row:
    recorded = load_euroc(path)
    truth = recorded.truth
    clock = position_clock(truth, recorded.imu_ns, recorded.accel_B)
    velocity = np.gradient(truth.p_WB, truth.t_ns * 1e-9, axis=0)
    row: Row = {
        "recording": path.name,
        "late_ms": 1e3 * clock.late_s,
        "sigma_ms": 1e3 * clock.sigma_s,
        "speed_m_s": float(np.sqrt((velocity**2).sum(axis=1).mean())),
    }
    return row | (dict(_flown(path, clock.late_s)) if path.parent.name == "euroc" else {})


def _flown(clip: Path, late_s: float) -> Iterator[tuple[str, Row]]:
    """What back-ends come to against the truth as stamped, and with its positions on time."""
    installed = registry.load()
    for backend in _BACKENDS:
        dataset = DatasetConfig(path=clip, options={"cameras": ["cam0"]})
        config = Config(dataset=dataset, detector=PartConfig(name="shi_tomasi"), backend=PartConfig(name=backend))
        with TemporaryDirectory() as temporary:
            folder = Path(temporary) / backend
            row = run(config, installed, folder)
            done = RunFolder.open(folder)
            estimate, truth = done.trajectory(), done.ground_truth()
        assert estimate is not None
        assert truth is not None
        on_time = evaluate(estimate, with_positions_of_later(truth, late_s))
        yield backend, {"ate_mm": row["ate_mm"], "on_time_mm": 1e3 * on_time.ate_m.rmse}


if __name__ == "__main__":
    main()
