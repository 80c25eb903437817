"""A back-end on the real corners of an AprilGrid under strong motion, against PnP on the metric board.

    python benchmarks/april.py [--record]

Once by the lens as published, which back-ends are told, and once by the one that fits the corners best.

Target: ATE at most 9 mm over the 36 s.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from april_board import april_sequence, board_poses, fitted_lens, read_board_views, reprojection_px, turned_otherwise
from common import BACKEND_COLUMNS, backend_rows, benchmark, present

from vioframe.bench import Row
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import TrackSequence


@benchmark
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool) -> None:
    """Real AprilGrid corners and real IMU readings, against PnP."""
    folder = data / "euroc_imu_april"

    def sequences() -> Iterator[tuple[Row, TrackSequence]]:
        views, published = read_board_views(folder), packaged_calibration("euroc", cameras=["cam0"]).cameras[0].model
        lenses = {"published": (published, np.eye(3)), "fitted": fitted_lens(views, published)}
        for name, lens in lenses.items():
            sequence = april_sequence(folder, truth_by=lens)
            pixels = reprojection_px(views, lens[0], *board_poses(views, lens[0]))
            pnp_px, turned_deg = float(np.sqrt(np.mean(pixels**2))), float(np.rad2deg(turned_otherwise(sequence)))
            yield {"lens": name, "pnp_px": pnp_px, "turned_deg": turned_deg}, sequence

    of_truth = {"lens": "", "pnp_px": ".3f", "turned_deg": ".3f"}
    present(
        "april",
        f"{backend}: AprilGrid corners, truth by PnP",
        backend_rows(sequences(), backend, assignments),
        {k: v for k, v in BACKEND_COLUMNS.items() if k != "seed"} | of_truth,
        {"backend": backend, "options": list(assignments)},
        keep,
    )


if __name__ == "__main__":
    main()
