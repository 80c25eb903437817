"""Calibration files of all formats, misshapen in every way."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from ruamel.yaml import YAML
from test_calibration import (
    KALIBR_IMU,
    LEFT_LENS,
    RIGHT_LENS,
    T_BC,
    VINS_FUSION,
    VINS_MONO,
    basalt,
    kalibr_camera,
    lenses_of,
    rows,
)

from faults.fuzzing import YAML_BOMBS, bounded, budgets, damaged, fuzz, misshapen, written
from vioframe.errors import CalibrationError
from vioframe.io.calibration import load_calibration, packaged_calibration, write_calibration

OPENVINS_CAMERA = kalibr_camera(f"T_imu_cam:{rows(T_BC)}")
FORMATS = {
    "kalibr": {
        "chain.yaml": f"cam0:{kalibr_camera(f'T_cam_imu:{rows(np.linalg.inv(T_BC))}')}",
        "imu.yaml": KALIBR_IMU,
    },
    "openvins": {
        "estimator_config.yaml": "relative_config_imucam: chain.yaml\nrelative_config_imu: imu.yaml\n",
        "chain.yaml": f"cam0:{OPENVINS_CAMERA}",
        "imu.yaml": f"imu0: {{Tw: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], {', '.join(KALIBR_IMU.splitlines()[1:])}}}\n",
    },
    "vins_mono": {"config.yaml": VINS_MONO},
    "vins_fusion": {"config.yaml": VINS_FUSION, "left.yaml": LEFT_LENS, "lenses/right.yaml": RIGHT_LENS},
    "basalt": {"calibration.json": json.dumps({"value0": basalt()})},
    "basalt_ds": {
        "calibration.json": json.dumps(
            {"value0": basalt(**lenses_of("ds", "fx fy cx cy xi alpha", 158.0, 158.0, 255.0, 257.0, -0.2, 0.6))}
        )
    },
}


@pytest.fixture(params=["euroc", *FORMATS])
def files(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, str]:
    """The text of a good calibration's files, by name."""
    if request.param in FORMATS:
        return dict(FORMATS[request.param])
    write_calibration(packaged_calibration("euroc", cameras=["cam0"]), tmp_path / "euroc")
    found = sorted((tmp_path / "euroc").rglob("*.yaml"))
    return {str(file.relative_to(tmp_path / "euroc")): file.read_text() for file in found}


def load(folder: Path) -> None:
    """Whatever is accepted must be a rig that one can fly with."""
    config = folder / "estimator_config.yaml"
    calibration = load_calibration(config if config.exists() else folder)
    for camera in calibration.cameras:
        with np.errstate(all="ignore"):
            camera.model.undistort([[0.0, 0.0], camera.model.resolution])
        assert min(camera.model.resolution) > 0
        assert np.isfinite(camera.p_BC).all()
        assert np.allclose(camera.R_BC @ camera.R_BC.T, np.eye(3), atol=1e-9)
        assert abs(camera.time_offset_ns) < 2**62
    noise = calibration.imu
    assert np.isfinite(
        [noise.gyro_density, noise.accel_density, noise.gyro_walk, noise.accel_walk, noise.rate_hz]
    ).all()
    assert noise.rate_hz > 0.0


def write(folder: Path, files: dict[str, str | bytes]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder


def trees(files: dict[str, str]) -> dict[str, object]:
    plain = {name: text.replace("!!opencv-matrix", "") for name, text in files.items()}
    return {name: YAML(typ="safe", pure=True).load(text) for name, text in plain.items()}


def test_the_good_ones_are_good(files, tmp_path):
    load(write(tmp_path / "good", files))
    load(write(tmp_path / "again", {name: written(tree) for name, tree in trees(files).items()}))


@budgets(quick=40, thorough=3000)
def test_keys_and_values(files, tmp_path, examples):
    def use(tree: dict[object, object]) -> None:
        folder = Path(mkdtemp(dir=tmp_path))
        load(write(folder, {str(name or "x"): written(document) for name, document in tree.items()}))

    fuzz(examples, misshapen(trees(files)), use)


@budgets(quick=25, thorough=2000)
def test_bytes(files, tmp_path, examples):
    name = max(files, key=lambda name: len(files[name]))

    def use(data: bytes) -> None:
        load(write(Path(mkdtemp(dir=tmp_path)), {**files, name: data}))

    fuzz(examples, damaged(files[name].encode()), use)


@pytest.mark.parametrize("bomb", YAML_BOMBS.values(), ids=YAML_BOMBS)
def test_a_bomb_is_refused(tmp_path, bomb):
    text = bomb.replace("KEY", "intrinsics") + "sensor_type: camera\ncamera_model: pinhole\n"
    with bounded(), pytest.raises(CalibrationError):
        load(write(tmp_path / "bad", {"cam0/sensor.yaml": text}))
