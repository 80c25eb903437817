"""Calibration files: cameras and IMU written in every format read back as the same rig."""

from pathlib import Path

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
        with pytest.raises(CalibrationError, match=rf"which images are those of cam0: .* cameras=cam0:{sources[0]}"):
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
        ("camera_model: pinhole", "camera_model: omni", "'camera_model' should be 'pinhole', not 'omni'"),
        ("distortion_model: radtan", "distortion_model: fov", "'distortion_model' should be 'radtan', "),
        ("intrinsics: [458.5, ", "intrinsics: [", "'intrinsics' should be 4 finite numbers"),
        ("intrinsics: [458.5, ", "intrinsics: [.nan, ", "'intrinsics' should be 4 finite numbers"),
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
