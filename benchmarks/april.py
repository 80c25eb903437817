"""A back-end on the real corners of an AprilGrid under strong motion, against PnP on the metric board.

    python benchmarks/april.py [--record]

Target: ATE at most 40 mm over the 36 s.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from april_board import april_sequence, board_poses, read_board_views, reprojection_px
from common import BACKEND_COLUMNS, backend_rows, benchmark, present

from vioframe.bench import Row
from vioframe.simulation import TrackSequence


@benchmark
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool) -> None:
    """Real AprilGrid corners and real IMU readings, against PnP."""
    folder = data / "euroc_imu_april"

    def sequences() -> Iterator[tuple[Row, TrackSequence]]:
        sequence = april_sequence(folder)
        views, camera = read_board_views(folder), sequence.calibration.cameras[0].model
        pixels = reprojection_px(views, camera, *board_poses(views, camera))
        yield {"pnp_px": float(np.sqrt(np.mean(pixels**2)))}, sequence

    present(
        "april",
        f"{backend}: AprilGrid corners, truth by PnP",
        backend_rows(sequences(), backend, assignments),
        {k: v for k, v in BACKEND_COLUMNS.items() if k != "seed"} | {"pnp_px": ".3f"},
        {"backend": backend, "options": list(assignments)},
        keep,
    )


if __name__ == "__main__":
    main()
