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
from vioframe.simulation import TrackSequence


@benchmark
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool) -> None:
    """Real AprilGrid corners and real IMU readings, against PnP."""
    folder = data / "euroc_imu_april"

    def sequences() -> Iterator[tuple[Row, TrackSequence]]:
        views = read_board_views(folder)
        for lens in ("published", "fitted"):
            sequence = april_sequence(folder, truth_as_calibrated=lens == "published")
            camera = sequence.calibration.cameras[0].model
            if lens == "fitted":
                camera, _ = fitted_lens(views, camera)
            pixels = reprojection_px(views, camera, *board_poses(views, camera))
            pnp_px, turned_deg = float(np.sqrt(np.mean(pixels**2))), float(np.rad2deg(turned_otherwise(sequence)))
            yield {"lens": lens, "pnp_px": pnp_px, "turned_deg": turned_deg}, sequence

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
