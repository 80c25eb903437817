"""Recordings of every format with bytes changed: what is there is read, the rest counted or named."""

from __future__ import annotations

from pathlib import Path
from shutil import copytree
from tempfile import mkdtemp

import numpy as np
import pytest
from hypothesis import strategies as st
from recordings import CALIBRATION, measurements, true_trajectory

from faults.fuzzing import budgets, damaged, fuzz
from vioframe.io.convert import convert
from vioframe.parts import registry
from vioframe.types import FrameSet, ImuSample, Unreadable

INSTALLED = registry.load()
NAMES = {"asl": "flight", "ros1": "flight.bag", "ros2": "flight.ros2", "mcap": "flight.mcap"}
COMPRESSED = {"ros1": "lz4", "ros2": "zstd", "mcap": "zstd"}


def read(path: Path) -> None:
    """All of it, checked."""
    dataset = INSTALLED.open_dataset(path, options={"cameras": ["cam0"]})
    assert isinstance(dataset.name, str)
    assert dataset.frame_count is None or dataset.frame_count >= 0
    for m in dataset.measurements():
        assert isinstance(m.t_ns, int)
        assert abs(m.t_ns) < 2**63
        if isinstance(m, ImuSample):
            assert (m.gyro_B.shape, m.accel_B.shape) == ((3,), (3,))
            assert (m.gyro_B.dtype, m.accel_B.dtype) == (float, float)
        elif isinstance(m, FrameSet):
            (image,) = m.images
            assert (image.shape, image.dtype) == ((48, 64), np.uint8)
        else:
            assert isinstance(m, Unreadable)
            assert m.kind.islower()
    truth = dataset.ground_truth
    assert truth is None or np.isfinite(truth.p_WB).all()


@pytest.fixture(scope="module", params=[*NAMES, *(f"{name} compressed" for name in COMPRESSED)])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images and their readings, with truth."""
    format, _, compressed = request.param.partition(" ")
    path = tmp_path_factory.mktemp("good") / NAMES[format]
    convert(
        measurements(4),
        CALIBRATION,
        path,
        truth=true_trajectory(),
        format=format,
        compression=COMPRESSED[format] if compressed else None,
    )
    return path


def test_the_good_ones_are_good(recording):
    read(recording)


@budgets(quick=25, thorough=2000)
def test_bytes(recording, tmp_path, examples):
    files = sorted(file for file in [recording, *recording.rglob("*")] if file.is_file())
    damage = st.sampled_from(files).flatmap(lambda file: st.tuples(st.just(file), damaged(file.read_bytes())))
    beside = recording.with_name(f"{recording.name}.calib")

    def use(made: tuple[Path, bytes]) -> None:
        file, data = made
        folder = Path(mkdtemp(dir=tmp_path))
        if recording.is_dir():
            copytree(recording, folder / recording.name)
        if beside.is_dir():
            (folder / beside.name).symlink_to(beside)
        (folder / file.relative_to(recording.parent)).write_bytes(data)
        read(folder / recording.name)

    fuzz(examples, damage, use)


ROWS = st.lists(
    st.one_of(
        st.sampled_from(
            [
                *("", ",", ",,,,,,,", "#", "nan,1,2,3,4,5,6", "1,nan,inf,-inf,1e999,0,0", "-1,0,0,0,0,0,9.8"),
                *(
                    "1e18,0,0,0,0,0,0",
                    "99999999999999999999999,0,0,0,0,0,0",
                    "1,2",
                    "1,2,3,4,5,6,7,8,9",
                    "\0,1",
                    "1,\0",
                ),
                *(
                    "١٢٣,1,2,3,4,5,6",
                    "1_000,1,2,3,4,5,6",
                    " 5 , 1,2,3,4,5,6",
                    "-9223372036854775808,a.png",
                    "0x10,a.png",
                ),
                *("1403636584763555601,../../../../etc/passwd", "5,/dev/zero", "5,.", "5,", "5," + "a" * 5000),
                *("9223372036854775807,0,0,0,0,0,0", "9223372036854775808,0,0,0,0,0,0", f"{'9' * 5000},0,0,0,0,0,0"),
                "5,data.csv/x",
            ]
        ),
        st.text(max_size=30),
    ),
    min_size=1,
    max_size=5,
)


@pytest.mark.parametrize("sensor", ["cam0", "imu0", "state_groundtruth_estimate0"])
@budgets(quick=25, thorough=1500)
def test_rows_of_a_table(tmp_path, sensor, examples):
    good = tmp_path / "good"
    convert(measurements(2), CALIBRATION, good, truth=true_trajectory())
    table = good / "mav0" / sensor / "data.csv"
    lines = table.read_text().splitlines()

    def use(made: tuple[list[str], int]) -> None:
        rows, place = made
        table.write_text("\n".join([*lines[:place], *rows, *lines[place:]]), encoding="utf-8", errors="surrogatepass")
        read(good)

    fuzz(examples, st.tuples(ROWS, st.integers(0, len(lines))), use)
