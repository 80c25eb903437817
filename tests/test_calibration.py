"""Calibration files: cameras and IMU written in every format read back as the same rig."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import assert_same_rig

from vioframe.errors import CalibrationError
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, DistortionModel
from vioframe.io.calibration import (
    load_calibration,
    match_cameras,
    packaged_calibration,
    sidecar_folder,
    write_calibration,
)
from vioframe.types import Calibration, CameraOnBody, ImuNoise

CAMERA = Camera(458.5, 457.25, 367.0, 248.5, (-0.28, 0.07, 0.0002, 1.76e-05), (752, 480))
R_BC = so3.exp([0.1, -0.2, 1.5])
P_BC = np.array([-0.0216, -0.0647, 0.0098])
T_BC = np.block([[R_BC, P_BC[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
NOISE = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3, 200.0)
OFFSET_NS = 5_250_000
RIG = Calibration((CameraOnBody("cam0", CAMERA, R_BC, P_BC, OFFSET_NS),), NOISE)

HEADERS = pytest.mark.parametrize(
    "header", ["", "%YAML:1.0\n", "%YAML:1.0\n---\n"], ids=["plain", "opencv", "opencv---"]
)


def rows(matrix: np.ndarray) -> str:
    return "".join(f"\n    - {row.tolist()}" for row in matrix)


def opencv_matrix(matrix: np.ndarray) -> str:
    height, width = matrix.shape
    return f"!!opencv-matrix\n   rows: {height}\n   cols: {width}\n   dt: d\n   data: {matrix.ravel().tolist()}"


def kalibr_camera(transform: str, camera: Camera = CAMERA, model: str = "radtan") -> str:
    return f"""
  {transform}
  camera_model: pinhole
  distortion_coeffs: {list(camera.distortion)}
  distortion_model: {model}
  intrinsics: {[camera.fx, camera.fy, camera.cx, camera.cy]}
  resolution: {list(camera.resolution)}
  rostopic: /left/image
  timeshift_cam_imu: 0.00525
"""


KALIBR_IMU = """
accelerometer_noise_density: 2e-3
accelerometer_random_walk: 3.0e-3
gyroscope_noise_density: 1.7e-04
gyroscope_random_walk: 1.9e-5
rostopic: /imu0
update_rate: 200.0
"""

VINS_MONO = f"""
imu_topic: "/imu0"
image_topic: "/left/image"
model_type: PINHOLE
camera_name: camera
image_width: 752
image_height: 480
distortion_parameters:
   k1: -0.28
   k2: 0.07
   p1: 0.0002
   p2: 1.76e-05
projection_parameters:
   fx: 458.5
   fy: 457.25
   cx: 367.
   cy: 248.5
estimate_extrinsic: 0
extrinsicRotation: {opencv_matrix(R_BC)}
extrinsicTranslation: {opencv_matrix(P_BC[:, None])}
acc_n: 0.08
gyr_n: 0.004
acc_w: 4.0e-05
gyr_w: 2.0e-6
td: 0.00525
"""


def assert_equal(calibration: Calibration, name: str = "cam0", noise: ImuNoise = NOISE) -> None:
    (camera,) = calibration.cameras
    assert (camera.name, camera.model, camera.time_offset_ns) == (name, CAMERA, OFFSET_NS)
    assert camera.rotation_known
    np.testing.assert_allclose(camera.R_BC, R_BC, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(camera.p_BC, P_BC, rtol=0.0, atol=1e-14)
    assert calibration.imu == noise


@HEADERS
def test_kalibr(tmp_path: Path, header: str) -> None:
    camchain, imu = tmp_path / "camchain-imucam.yaml", tmp_path / "imu.yaml"
    camchain.write_text(header + "cam0:" + kalibr_camera(f"T_cam_imu: {rows(np.linalg.inv(T_BC))}"))
    imu.write_text(header + KALIBR_IMU)
    assert_equal(load_calibration(camchain, imu))
    assert_equal(load_calibration(imu, camchain))
    assert_equal(load_calibration(tmp_path))
    # Kalibr's own result nests the IMU.
    imu.write_text(header + "imu0:" + KALIBR_IMU.replace("\n", "\n  "))
    assert_equal(load_calibration(camchain, imu))


@HEADERS
def test_openvins(tmp_path: Path, header: str) -> None:
    (tmp_path / "kalibr_imucam_chain.yaml").write_text(header + "cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}"))
    (tmp_path / "kalibr_imu_chain.yaml").write_text(header + "imu0:" + KALIBR_IMU.replace("\n", "\n  "))
    estimator = tmp_path / "estimator_config.yaml"
    estimator.write_text(
        header
        + 'verbosity: "INFO" # ALL, DEBUG\nuse_fej: true\n'
        + 'relative_config_imu: "kalibr_imu_chain.yaml"\nrelative_config_imucam: "kalibr_imucam_chain.yaml"\n'
    )
    assert_equal(load_calibration(estimator))
    assert_equal(load_calibration(tmp_path))
    assert_equal(load_calibration(str(tmp_path / "kalibr_imucam_chain.yaml"), str(tmp_path / "kalibr_imu_chain.yaml")))


def test_openvins_imu_intrinsics_that_are_not_applied_are_announced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "imucam.yaml").write_text("cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}"))
    imu = (
        KALIBR_IMU + "Ta:\n- [1.0, 0.0, 0.0]\n- [0.0, 1.0, 0.0]\n- [0.0, 0.0, 1.0]\nTw:\n" + "- [1.01, 0.0, 0.0]\n" * 3
    )
    (tmp_path / "imu.yaml").write_text("imu0:" + imu.replace("\n", "\n  "))
    load_calibration(tmp_path)
    assert [record.args[1] for record in caplog.records] == ["Tw"]


@HEADERS
def test_vins_mono(tmp_path: Path, header: str) -> None:
    file = tmp_path / "euroc_config.yaml"
    file.write_text(header + VINS_MONO)
    scale = 200.0**-0.5  # per-sample noise -> density
    noise = ImuNoise(0.004 * scale, 0.08 * scale, 2e-6 * scale, 4e-5 * scale, 200.0)
    assert_equal(load_calibration(file), noise=noise)
    assert_equal(load_calibration(file, cameras=["/any/topic"]), noise=noise)


@pytest.mark.parametrize(("said", "readout_s"), [("1", 0.0333), ("0", 0.0)])
def test_vins_mono_rolling_shutter(tmp_path: Path, said: str, readout_s: float) -> None:
    file = tmp_path / "phone.yaml"
    file.write_text(f"{VINS_MONO}\nrolling_shutter: {said}\nrolling_shutter_tr: 0.0333\n")
    assert load_calibration(file).cameras[0].readout_s == readout_s


def test_kalibr_rolling_shutter(tmp_path: Path) -> None:
    chain, imu = tmp_path / "chain.yaml", tmp_path / "imu.yaml"
    chain.write_text("cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}") + "  readout_time: 0.0213\n")
    imu.write_text(KALIBR_IMU)
    (camera,) = load_calibration(chain, imu).cameras
    assert camera.readout_s == 0.0213
    # The middle row at the stamp, the first half the readout before it.
    np.testing.assert_allclose(camera.row(np.array([-0.5, 239.5, 479.5])), [-0.5, 0.0, 0.5])


def test_vins_mono_kannala_brandt(tmp_path: Path) -> None:
    file = tmp_path / "fisheye.yaml"
    before, _, after = VINS_MONO.partition("distortion_parameters:")
    _, _, after = after.partition("estimate_extrinsic: 0")
    fisheye = {"k2": -0.28, "k3": 0.07, "k4": 0.0002, "k5": 1.76e-05, "mu": 458.5, "mv": 457.25, "u0": 367, "v0": 248.5}
    lines = "".join(f"   {key}: {value}\n" for key, value in fisheye.items())
    file.write_text(before.replace("PINHOLE", "KANNALA_BRANDT") + "projection_parameters:\n" + lines + after)
    camera = load_calibration(file).cameras[0].model
    assert camera == Camera(458.5, 457.25, 367.0, 248.5, CAMERA.distortion, (752, 480), "equidistant")


@HEADERS
def test_euroc(tmp_path: Path, header: str) -> None:
    write_calibration(RIG, tmp_path / "mav0")
    for file in tmp_path.rglob("sensor.yaml"):
        file.write_text(header + file.read_text())
    cam, imu = tmp_path / "mav0" / "cam0", tmp_path / "mav0" / "imu0"
    assert_equal(load_calibration(cam / "sensor.yaml", imu / "sensor.yaml"))
    assert_equal(load_calibration(tmp_path))
    assert_equal(load_calibration(tmp_path / "mav0", cameras=["cam0"]))
    # Flat copies are named by their files.
    (tmp_path / "cam7.yaml").write_text((cam / "sensor.yaml").read_text())
    assert_equal(load_calibration(tmp_path / "cam7.yaml", imu / "sensor.yaml", cameras=["cam7"]), "cam7")


def test_euroc_imu_away_from_the_body_frame(tmp_path: Path) -> None:
    """B is the IMU: with the IMU at T_BI in EuRoC's body frame, the camera is at inv(T_BI) T_BC."""
    write_calibration(RIG, tmp_path)
    sensor = tmp_path / "imu0" / "sensor.yaml"
    identity = ",\n         ".join(str(row)[1:-1] for row in np.eye(4).tolist())
    T_BI = np.eye(4)
    T_BI[:3, :3], T_BI[:3, 3] = so3.exp([0.3, 0.2, -0.1]), [0.1, 0.2, 0.3]
    assert identity in sensor.read_text()
    sensor.write_text(sensor.read_text().replace(identity, str(T_BI.ravel().tolist())[1:-1]))
    (camera,) = load_calibration(tmp_path).cameras
    expected = np.linalg.inv(T_BI) @ T_BC
    np.testing.assert_allclose(camera.R_BC, expected[:3, :3], rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(camera.p_BC, expected[:3, 3], rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("model", ["radtan", "equidistant"])
def test_written_calibrations_read_back_to_the_last_bit(tmp_path: Path, model: DistortionModel) -> None:
    odd = Camera(1 / 3, 2 / 3, 1e-17, 1e17, (0.1 + 0.2, -1e-300, 0.0, 1.0), (752, 480), model)
    cameras = (
        CameraOnBody("cam0", odd, np.eye(3), np.array([1 / 3, -1e-20, 7.0]), -123_456_789_012),
        CameraOnBody("cam1", CAMERA, np.eye(3), P_BC, OFFSET_NS, rotation_known=False, readout_s=1 / 30),
        CameraOnBody("thermal", CAMERA, R_BC, P_BC, readout_s=-0.1),
        *packaged_calibration("euroc").with_camera(0, name="cam2").with_camera(1, name="cam3").cameras,
    )
    cameras = tuple(sorted(cameras, key=lambda camera: camera.name))
    write_calibration(Calibration(cameras, NOISE), tmp_path)
    back = load_calibration(tmp_path)
    assert_same_rig(back, Calibration(cameras, NOISE))


def kalibr_pair() -> str:
    one = kalibr_camera(f"T_imu_cam: {rows(T_BC)}")
    return "cam1:" + one.replace("367.0", "400.0").replace("/left", "/right") + "cam0:" + one


@pytest.mark.parametrize(
    ("wanted", "names"),
    [
        (None, ["cam0", "cam1"]),
        (["cam1"], ["cam1"]),
        (["cam1", "cam0"], ["cam1", "cam0"]),
        (["/right/image"], ["cam1"]),
        (["/cam1/image_raw", "/left/image"], ["cam1", "cam0"]),
    ],
)
def test_cameras_are_chosen_by_name_or_topic(tmp_path: Path, wanted: list[str] | None, names: list[str]) -> None:
    (tmp_path / "chain.yaml").write_text(kalibr_pair())
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    cameras = load_calibration(tmp_path, cameras=wanted).cameras
    assert [camera.name for camera in cameras] == names
    assert [camera.model.cx for camera in cameras] == [{"cam0": 367.0, "cam1": 400.0}[name] for name in names]


def test_an_unknown_camera_is_an_error_unless_there_is_no_choice(tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    chain = tmp_path / "chain.yaml"
    chain.write_text("cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}"))
    assert_equal(load_calibration(tmp_path, cameras=["/some/other/topic"]))
    with pytest.raises(CalibrationError, match=r"no camera 'cam1'; choose one of: cam0"):
        load_calibration(tmp_path, cameras=["cam1"])
    chain.write_text(kalibr_pair())
    with pytest.raises(CalibrationError, match=r"no camera '/some/other/topic'; choose one of: cam0, cam1"):
        load_calibration(tmp_path, cameras=["/some/other/topic"])
    with pytest.raises(CalibrationError, match=r"names of their own, got \['cam1', 'cam1'\]"):
        load_calibration(tmp_path, cameras=["cam1", "/right/image"])


T_BC1 = np.block([[so3.exp([0.2, 0.1, -0.4]), np.array([[0.1], [0.2], [-0.3]])], [np.zeros((1, 3)), np.ones((1, 1))]])

VINS_FUSION = f"""
imu: 1
num_of_cam: 2
imu_topic: "/imu0"
image0_topic: "/left/image"
image1_topic: "/right/image"
cam0_calib: "left.yaml"
cam1_calib: "lenses/right.yaml"
image_width: 752
image_height: 480
estimate_extrinsic: 1   # 1: a first guess
body_T_cam0: {opencv_matrix(T_BC)}
body_T_cam1: {opencv_matrix(T_BC1)}
acc_n: 0.08
gyr_n: 0.004
acc_w: 4.0e-05
gyr_w: 2.0e-6
td: 0.00525
"""


# A pinhole with the numbers of CAMERA, and a fisheye.
LEFT_LENS = VINS_MONO[VINS_MONO.index("model_type") : VINS_MONO.index("estimate_extrinsic")]
RIGHT_LENS = """
model_type: KANNALA_BRANDT
image_width: 640
image_height: 400
projection_parameters: {k2: 0.1, k3: -0.02, k4: 0.003, k5: -0.0004, mu: 300., mv: 301., u0: 320., v0: 200.}
"""


def vins_fusion(folder: Path, header: str = "", main: str = VINS_FUSION) -> Path:
    """The main file, with its two lenses beside and below it."""
    (folder / "left.yaml").write_text(header + LEFT_LENS)
    (folder / "lenses").mkdir()
    (folder / "lenses" / "right.yaml").write_text(header + RIGHT_LENS)
    (folder / "stereo_imu.yaml").write_text(header + main)
    return folder / "stereo_imu.yaml"


@HEADERS
def test_vins_fusion(tmp_path: Path, header: str) -> None:
    main = vins_fusion(tmp_path, header)
    scale = 200.0**-0.5
    noise = ImuNoise(0.004 * scale, 0.08 * scale, 2e-6 * scale, 4e-5 * scale, 200.0)
    fisheye = Camera(300.0, 301.0, 320.0, 200.0, (0.1, -0.02, 0.003, -0.0004), (640, 400), "equidistant")
    for given in (main, tmp_path):
        calibration = load_calibration(given)
        assert_equal(calibration.only(0), noise=noise)
        (_, second) = calibration.cameras
        assert (second.name, second.model, second.time_offset_ns) == ("cam1", fisheye, OFFSET_NS)
        np.testing.assert_allclose(second.R_BC, T_BC1[:3, :3], rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(second.p_BC, T_BC1[:3, 3], rtol=0.0, atol=1e-14)
    assert [camera.name for camera in load_calibration(main, cameras=["/right/image"]).cameras] == ["cam1"]
    main.write_text(header + VINS_FUSION.replace("num_of_cam: 2", "num_of_cam: 1"))
    assert_equal(load_calibration(main), noise=noise)
    main.write_text(header + VINS_FUSION.replace("estimate_extrinsic: 1", "estimate_extrinsic: 2"))
    assert [camera.rotation_known for camera in load_calibration(main).cameras] == [False, False]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('cam1_calib: "lenses/right.yaml"', "", "'cam1_calib' is missing"),
        ("lenses/right.yaml", "right.yaml", "cannot read the calibration"),
        ("body_T_cam1", "T_cam1", "'body_T_cam1' is missing"),
        ("num_of_cam: 2", "num_of_cam: 3", "'num_of_cam' should be 1 or 2, not 3"),
        ("gyr_n: 0.004", "", "'gyr_n' is missing"),
    ],
)
def test_mistakes_in_vins_fusions_files_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in VINS_FUSION
    main = vins_fusion(tmp_path, main=VINS_FUSION.replace(old, new))
    with pytest.raises(CalibrationError) as caught:
        load_calibration(main)
    assert message in str(caught.value)
    with pytest.raises(CalibrationError, match="the main file of VINS-Fusion"):
        load_calibration(tmp_path / "left.yaml")


def basalt(**changes: object) -> dict[str, object]:
    """Two cameras in Basalt's format, the first with the pose of ``T_BC``."""

    def pose(T: np.ndarray) -> dict[str, float]:
        # Independent of the reader: Shepperd's formula where the trace is positive.
        R, w = T[:3, :3], 0.5 * np.sqrt(1.0 + np.trace(T[:3, :3]))
        x, y, z = (R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]) / (4.0 * w)
        return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), (*T[:3, 3], x, y, z, w), strict=True))

    lens = {"fx": 190.5, "fy": 191.25, "cx": 254.5, "cy": 256.5, "k1": 0.0034, "k2": 7e-4, "k3": -2e-3, "k4": 1e-05}
    told = {
        "T_imu_cam": [pose(T_BC), pose(T_BC1)],
        "intrinsics": [{"camera_type": "kb4", "intrinsics": lens}] * 2,
        "resolution": [[512, 512], [640, 480]],
        "vignette": [],
        "calib_accel_bias": [0.1, -0.2, 0.3] + 6 * [0.0],
        "calib_gyro_bias": 12 * [0.0],
        "imu_update_rate": 200.0,
        "accel_noise_std": [0.0028, 0.0028, 0.0028],
        "gyro_noise_std": [1.6e-4, 1.5e-4, 1.6e-4],
        "accel_bias_std": [8.6e-4, 8.6e-4, 8.6e-4],
        "gyro_bias_std": [2.2e-05, 2.2e-05, 2.2e-05],
        "cam_time_offset_ns": OFFSET_NS,
    }
    return told | changes


def write_basalt(folder: Path, **changes: object) -> Path:
    file = folder / "calibration.json"
    file.write_text(json.dumps({"value0": basalt(**changes)}, indent=4))
    return file


def test_basalt(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = write_basalt(tmp_path)
    model = Camera(190.5, 191.25, 254.5, 256.5, (0.0034, 7e-4, -2e-3, 1e-5), (512, 512), "equidistant")
    for given in (file, tmp_path):
        calibration = load_calibration(given)
        assert [camera.name for camera in calibration.cameras] == ["cam0", "cam1"]
        assert calibration.lenses == (model, replace(model, resolution=(640, 480)))
        assert [camera.time_offset_ns for camera in calibration.cameras] == [OFFSET_NS, OFFSET_NS]
        for camera, T in zip(calibration.cameras, (T_BC, T_BC1), strict=True):
            np.testing.assert_allclose(camera.R_BC, T[:3, :3], rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(camera.p_BC, T[:3, 3], rtol=0.0, atol=1e-14)
        assert calibration.imu == ImuNoise(1.6e-4, 0.0028, 2.2e-5, 8.6e-4, 200.0)
    assert not caplog.records
    write_basalt(tmp_path, calib_gyro_bias=[0.0, 0.0, 0.0, 0.01, *(8 * [0.0])], accel_noise_std=0.0028)
    assert load_calibration(file).imu.accel_density == 0.0028
    assert [record.args[1] for record in caplog.records] == ["calib_gyro_bias"]


def rays(most_deg: float) -> np.ndarray:
    """(N, 3) points all round the axis, up to ``most_deg`` from it."""
    angle, around = np.meshgrid(np.deg2rad(np.linspace(0.0, most_deg, 60)), np.linspace(0.0, 6.2, 24))
    columns = np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)
    return 3.0 * np.column_stack([column.ravel() for column in columns])


def test_basalts_kannala_brandt_is_opencvs_fisheye(tmp_path: Path) -> None:
    model = load_calibration(write_basalt(tmp_path)).cameras[0].model
    K, k = np.array([[190.5, 0.0, 254.5], [0.0, 191.25, 256.5], [0.0, 0.0, 1.0]]), np.array([0.0034, 7e-4, -2e-3, 1e-5])
    p_C = rays(80.0)
    expected, _ = cv2.fisheye.projectPoints(p_C[:, None], np.zeros(3), np.zeros(3), K, k)
    np.testing.assert_allclose(model.project(p_C), expected[:, 0], rtol=0.0, atol=1e-9)


def double_sphere(p_C: np.ndarray, *, xi: float, alpha: float) -> np.ndarray:
    """Usenko, Demmel, Cremers 2018, equations 40 to 43, of fx = fy = 1."""
    x, y, z = p_C.T
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    return p_C[:, :2] / (alpha * d2 + (1.0 - alpha) * (xi * d1 + z))[:, None]


def extended_unified(p_C: np.ndarray, *, alpha: float, beta: float = 1.0) -> np.ndarray:
    """Khomutenko, Garcia, Martinet 2016."""
    x, y, z = p_C.T
    d = np.sqrt(beta * (x * x + y * y) + z * z)
    return p_C[:, :2] / (alpha * d + (1.0 - alpha) * z)[:, None]


# fx, the model's own numbers, how far out the image goes: a lens of 195 degrees, EuRoC's, a long one, a pinhole.
@pytest.mark.parametrize(
    ("kind", "focal", "own", "most_deg"),
    [
        ("ds", 158.0, {"xi": -0.172, "alpha": 0.593}, 89.5),
        ("ds", 350.0, {"xi": -0.237, "alpha": 0.566}, 45.0),
        ("ds", 900.0, {"xi": 0.1, "alpha": 0.3}, 15.0),
        ("eucm", 460.0, {"alpha": 0.59, "beta": 1.13}, 40.0),
        ("ucm", 190.0, {"alpha": 0.65}, 70.0),
        ("ds", 420.0, {"xi": 0.0, "alpha": 0.0}, 35.0),
    ],
)
@pytest.mark.parametrize("format", ["basalt", "kalibr"])
def test_lenses_of_other_models_are_told_to_a_hundredth_of_a_pixel(
    tmp_path: Path, format: str, kind: str, focal: float, own: dict[str, float], most_deg: float
) -> None:
    p_C = rays(most_deg)
    project = double_sphere if kind == "ds" else extended_unified
    f, c = np.array([focal, 1.01 * focal]), np.array([255.0, 257.0])
    expected = project(p_C, **own) * f + c
    if format == "basalt":
        told = {"fx": f[0], "fy": f[1], "cx": c[0], "cy": c[1], **own}
        file = write_basalt(tmp_path, intrinsics=[{"camera_type": kind, "intrinsics": told}] * 2)
        camera = load_calibration(file).cameras[0].model
    else:
        # The unified model is Kalibr's eucm with beta = 1.
        model, numbers = ("ds", [*own.values()]) if kind == "ds" else ("eucm", [own["alpha"], own.get("beta", 1.0)])
        text = kalibr_camera(f"T_imu_cam: {rows(T_BC)}", model="none").replace("pinhole", model)
        text = re.sub(r"intrinsics: .*", f"intrinsics: {[*numbers, *f.tolist(), *c.tolist()]}", text)
        text = re.sub(r"resolution: .*", "resolution: [512, 512]", re.sub(r"distortion_coeffs: .*", "", text))
        (tmp_path / "chain.yaml").write_text("cam0:" + text)
        (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
        camera = load_calibration(tmp_path).cameras[0].model
    within = camera.contains(expected)
    assert within.sum() > 300
    np.testing.assert_allclose(camera.project(p_C[within]), expected[within], rtol=0.0, atol=0.02)
    # And back: what lies beyond 90 degrees has no point with z = 1.
    back = camera.undistort(expected[within])
    np.testing.assert_allclose(back, p_C[within, :2] / p_C[within, 2:], rtol=2e-3, atol=1e-4)


def test_rays_beyond_90_degrees_are_none(tmp_path: Path) -> None:
    own = {"xi": -0.172, "alpha": 0.593}
    told = {"fx": 158.0, "fy": 158.0, "cx": 255.0, "cy": 257.0, **own}
    camera = load_calibration(write_basalt(tmp_path, intrinsics=[{"camera_type": "ds", "intrinsics": told}] * 2))
    beyond = rays(97.0)
    beyond = beyond[beyond[:, 2] < -0.05]
    pixels = 158.0 * double_sphere(beyond, **own) + [255.0, 257.0]
    assert np.isnan(camera.lenses[0].undistort(pixels)).all()


def lenses_of(kind: str, keys: str, *values: float) -> dict[str, object]:
    """Both cameras with the same lens, in Basalt's format."""
    numbers = dict(zip(keys.split(), values, strict=True))
    return {"intrinsics": [{"camera_type": kind, "intrinsics": numbers}] * 2}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (lenses_of("kb4", "fx", 1.0), "[cam0]: 'fy' is missing"),
        (lenses_of("fov", "fx", 1.0), "'camera_type' should be 'pinhole', "),
        ({"resolution": [[512, 512]]}, "should be of as many cameras"),
        ({"T_imu_cam": [dict.fromkeys(("px", "py", "pz", "qx", "qy", "qz", "qw"), 0.0)] * 2}, "their norm is not 1"),
        ({"gyro_noise_std": [0.0, 0.0, 0.0]}, "'gyro_noise_std' should be greater than 0"),
        ({"imu_update_rate": None}, "'imu_update_rate' should be a valid number"),
        (
            lenses_of("ds", "fx fy cx cy xi alpha", 9, 9, 9, 9, -5.0, 0.5),
            "calibrate again with Basalt's 'kb4' or Kalibr's 'pinhole-equi'",
        ),
        (
            lenses_of("pinhole-radtan8", "fx fy cx cy k1 k2 p1 p2 k4", 9, 9, 9, 9, 0, 0, 0, 0, 0.1),
            "no k3 to k6; calibrate again with 'kb4'",
        ),
    ],
)
def test_mistakes_in_basalts_file_are_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        load_calibration(write_basalt(tmp_path, **changes))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_basalts_pinholes(tmp_path: Path) -> None:
    keys, numbers = "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", (458.5, 457.25, 367.0, 248.5, *CAMERA.distortion, 0, 0, 0, 0)
    kinds = [
        {"camera_type": kind, "intrinsics": dict(zip(keys.split()[:count], numbers, strict=False))}
        for kind, count in (("pinhole-radtan8", 12), ("pinhole", 4))
    ]
    lenses = load_calibration(write_basalt(tmp_path, intrinsics=kinds, resolution=[[752, 480]] * 2)).lenses
    assert lenses == (CAMERA, replace(CAMERA, distortion=(0.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("transform", ["T_imu_cam", "T_cam_imu"])
def test_both_cameras_of_a_chain_come_with_poses_of_their_own(tmp_path: Path, transform: str) -> None:
    """Kalibr's and OpenVINS': ``T_cn_cnm1`` beside them is not needed."""
    poses = {"cam0": T_BC, "cam1": T_BC1}
    chain = ""
    for name, T in poses.items():
        chain += f"{name}:" + kalibr_camera(f"{transform}: {rows(T if transform == 'T_imu_cam' else np.linalg.inv(T))}")
    (tmp_path / "chain.yaml").write_text(chain + f"  T_cn_cnm1: {rows(np.linalg.inv(T_BC1) @ T_BC)}\n")
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    for camera in load_calibration(tmp_path).cameras:
        np.testing.assert_allclose(camera.R_BC, poses[camera.name][:3, :3], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(camera.p_BC, poses[camera.name][:3, 3], rtol=0.0, atol=1e-12)


def test_cameras_are_matched_with_the_images_of_a_recording(tmp_path: Path) -> None:
    chain, imu = tmp_path / "chain.yaml", tmp_path / "imu.yaml"
    imu.write_text(KALIBR_IMU)
    chain.write_text(kalibr_pair())

    def matched(*sources: str, cameras: list[str] | None = None) -> list[tuple[str, str]]:
        calibration, found = match_cameras([chain, imu], sources, cameras)
        return [(camera.name, source) for camera, source in zip(calibration.cameras, found, strict=True)]

    # The topic a calibration was made from comes before the camera's name; what has no images is left out.
    assert matched("/cam0/x", "/left/image", "/right/image") == [("cam0", "/left/image"), ("cam1", "/right/image")]
    assert matched("/cam0/a", "/cam0/b", "/cam1/a") == [("cam0", "/cam0/a"), ("cam1", "/cam1/a")]
    assert matched("/cam1/a", "/other") == [("cam1", "/cam1/a")]
    assert matched("/cam0/a", "/cam0/b", cameras=["/cam0/b"]) == [("cam0", "/cam0/b")]
    assert matched("/a", "/b", cameras=["cam1:/a", "cam0:/b"]) == [("cam1", "/a"), ("cam0", "/b")]
    assert matched("/only", cameras=["cam1"]) == [("cam1", "/only")]
    for sources, wanted in ((("/a", "/b"), None), (("/a", "/b"), ["cam0"]), (("/cam1/a",), ["cam0"])):
        with pytest.raises(CalibrationError, match=rf"which images are those of cam0: .* --cameras cam0:{sources[0]}"):
            matched(*sources, cameras=wanted)
    chain.write_text("cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}"))
    assert matched("/a", "/b") == matched("/a", "/b", cameras=["cam0"]) == [("cam0", "/a")]


@pytest.mark.parametrize("format", ["euroc", "euroc without T_BS", "kalibr", "vins_mono"])
def test_a_camera_whose_rotation_nobody_knows(tmp_path: Path, format: str) -> None:
    file = tmp_path / "calibration.yaml"
    if format.startswith("euroc"):
        write_calibration(RIG, tmp_path / "files")
        sensor = tmp_path / "files" / "cam0" / "sensor.yaml"
        text = sensor.read_text()
        if format == "euroc without T_BS":
            text = "sensor_type: camera\n" + text[text.index("resolution") :]
        sensor.write_text(text + "camera_rotation: unknown\n")
        file = tmp_path / "files"
    elif format == "kalibr":
        # Only the position of the transform counts.
        nonsense = np.block([[np.zeros((3, 3)), P_BC[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
        file.write_text("cam0:" + kalibr_camera(f"camera_rotation: unknown\n  T_imu_cam: {rows(nonsense)}"))
        file = tmp_path
    else:
        text = VINS_MONO.replace("estimate_extrinsic: 0", "estimate_extrinsic: 2")
        file.write_text(text.replace(f"extrinsicRotation: {opencv_matrix(R_BC)}\n", ""))
    (camera,) = load_calibration(file).cameras
    assert not camera.rotation_known
    np.testing.assert_array_equal(camera.R_BC, np.eye(3))
    np.testing.assert_array_equal(camera.p_BC, np.zeros(3) if "without" in format else P_BC)
    assert (camera.model, camera.time_offset_ns) == (CAMERA, OFFSET_NS)


def test_what_cannot_be_told_without_the_rotation_is_refused(tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    for said, message in (
        ("unknown", "T_cam_imu tells no position"),
        ("maybe", "should be 'known' or 'unknown', not 'maybe'"),
    ):
        text = kalibr_camera(f"camera_rotation: {said}\n  T_cam_imu: {rows(T_BC)}")
        (tmp_path / "chain.yaml").write_text("cam0:" + text)
        with pytest.raises(CalibrationError, match=message):
            load_calibration(tmp_path)


def test_distortion_models(tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    chain = tmp_path / "chain.yaml"
    transform = f"T_imu_cam: {rows(T_BC)}"
    chain.write_text("cam0:" + kalibr_camera(transform, model="equidistant"))
    assert load_calibration(tmp_path).cameras[0].model.distortion_model == "equidistant"
    chain.write_text("cam0:" + kalibr_camera(transform, model="none").replace("-0.28, 0.07, 0.0002, 1.76e-05", ""))
    assert load_calibration(tmp_path).cameras[0].model.distortion == (0.0, 0.0, 0.0, 0.0)
    chain.write_text(chain.read_text().replace("distortion_coeffs: []", ""))
    assert load_calibration(tmp_path).cameras[0].model.distortion == (0.0, 0.0, 0.0, 0.0)
    # A third radial coefficient is harmless only where it is zero.
    chain.write_text("cam0:" + kalibr_camera(transform).replace("1.76e-05]", "1.76e-05, 0.0]"))
    assert load_calibration(tmp_path).cameras[0].model == CAMERA
    chain.write_text("cam0:" + kalibr_camera(transform).replace("1.76e-05]", "1.76e-05, 0.1]"))
    with pytest.raises(CalibrationError, match="k3"):
        load_calibration(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "camera_model: pinhole",
            "camera_model: omni",
            "should be 'pinhole', 'ds' or 'eucm', not 'omni'",
        ),
        ("distortion_model: radtan", "distortion_model: fov", "'distortion_model' should be 'radtan', "),
        ("intrinsics: [458.5, ", "intrinsics: [", "'intrinsics' should be 4 or 6 finite numbers"),
        ("intrinsics: [458.5, ", "intrinsics: [.nan, ", "'intrinsics' should be 4 or 6 finite numbers"),
        ("intrinsics: [458.5, ", "intrinsics: [-458.5, ", "fx, fy > 0"),
        ("resolution: [752, 480]", "resolution: wide", "'resolution' should be 2 numbers, not 'wide'"),
        ("resolution: [752, 480]", "", "'resolution' is missing"),
        ("camera_model: pinhole", "", "'camera_model' is missing"),
        ("T_imu_cam", "T_cn_cnm1", "use the result of kalibr_calibrate_imu_camera"),
        ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.1, 1.0]", "last row of 'T_imu_cam'"),
        ("    - [", "    - [9.0, ", "'T_imu_cam' should be 16 finite numbers"),
        ("cam0:", "cam0: [", "not valid YAML"),
        ("cam0:", "cam0: 7\nother:", "chain.yaml [cam0] holds no calibration: expected 'key: value' lines"),
        (
            "distortion_coeffs: [-0.28, ",
            "distortion_coeffs: [",
            "should be 0 or 4 or 5 finite numbers",
        ),
        ("distortion_coeffs:", "coeffs:", "distortion needs four coefficients"),
        ("rostopic:", "readout_time: 30\n  rostopic:", "'readout_time' should be less than 1, not 30"),
        ("cam0:\n", "camera:\n", "not a calibration of a known format"),
    ],
)
def test_mistakes_are_named_with_their_file_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = "cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}")
    assert old in text
    chain, imu = tmp_path / "chain.yaml", tmp_path / "imu.yaml"
    chain.write_text(text.replace(old, new))
    imu.write_text(KALIBR_IMU)
    with pytest.raises(CalibrationError) as caught:
        load_calibration(chain, imu)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_matrix_that_is_no_rotation_is_refused(tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    for wrong in (np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.1, 1.0, 1.0, 1.0])):
        (tmp_path / "chain.yaml").write_text("cam0:" + kalibr_camera(f"T_imu_cam: {rows(wrong)}"))
        with pytest.raises(CalibrationError, match="'T_imu_cam' holds no rotation"):
            load_calibration(tmp_path)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    chain, imu = tmp_path / "chain.yaml", tmp_path / "imu.yaml"
    with pytest.raises(CalibrationError, match=r"no calibration file .* in the folder"):
        load_calibration(tmp_path)
    with pytest.raises(CalibrationError, match=r"cannot read the calibration .*chain.yaml: No such file"):
        load_calibration(chain)
    chain.write_text("cam0:" + kalibr_camera(f"T_imu_cam: {rows(T_BC)}"))
    with pytest.raises(CalibrationError, match=r"no IMU noise is given .*; name the IMU's YAML file too"):
        load_calibration(chain)
    imu.write_text(KALIBR_IMU)
    with pytest.raises(CalibrationError, match=r"no camera is described .*; name the camera's YAML file too"):
        load_calibration(imu)
    imu.write_text(KALIBR_IMU.replace("3.0e-3", "0.0"))
    with pytest.raises(CalibrationError, match=r"'accelerometer_random_walk' should be greater than 0, not 0\.0"):
        load_calibration(chain, imu)
    imu.write_text(KALIBR_IMU)
    (tmp_path / "chain2.yaml").write_text(chain.read_text())
    with pytest.raises(CalibrationError, match="more than once; name the files to use"):
        load_calibration(tmp_path)


def test_sidecar_folder_lies_beside_the_recording(tmp_path: Path) -> None:
    assert sidecar_folder(tmp_path / "flight.bag") == tmp_path / "flight.bag.calib"


@pytest.mark.parametrize("place", ["calib_MH", "calib_V1"])
def test_the_packaged_calibration_is_that_of_the_data_set(shared_data: Path, place: str) -> None:
    assert_same_rig(packaged_calibration("euroc"), load_calibration(shared_data / "euroc_imu_gt" / place))


def test_the_packaged_calibration() -> None:
    calibration = packaged_calibration("euroc", cameras=["cam0"])
    (camera,) = calibration.cameras
    assert camera.model == Camera(
        458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05), (752, 480)
    )
    assert calibration.imu == ImuNoise(1.6968e-04, 2.0e-3, 1.9393e-05, 3.0e-3, 200.0)
    np.testing.assert_allclose(camera.R_BC[0], [0.0148655429818, -0.999880929698, 0.00414029679422], atol=1e-9)
    np.testing.assert_array_equal(camera.p_BC, [-0.0216401454975, -0.064676986768, 0.00981073058949])
    assert camera.time_offset_ns == 0
    assert [camera.name for camera in packaged_calibration("euroc").cameras] == ["cam0", "cam1"]
