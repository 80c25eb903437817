"""``vioframe check``: what it finds in recordings, how it says it, and what a run that comes to nothing says."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from rendered_flight import CALIBRATION, rendered_flight

from vioframe.cli import main
from vioframe.diagnosis import CAUSES, Certainty, Diagnosis, Finding, Gatherer, Severity, diagnose
from vioframe.diagnosis.findings import ranked
from vioframe.diagnosis.motion import moving_windows
from vioframe.runs.folder import RunFolder
from vioframe.types import Calibration, FrameSet, ImuSample, Measurement, Unreadable


def looked_at(
    measurements: list[Measurement] | None = None, calibration: Calibration = CALIBRATION, **options: float
) -> Diagnosis:
    """What is found without following points: stamps, readings, images."""
    gatherer = Gatherer(calibration, **options)
    for measurement in rendered_flight().measurements if measurements is None else measurements:
        gatherer.add(measurement)
    return diagnose(gatherer.recording())


def changed(kind: type, change) -> list[Measurement]:
    """The flight with all that is of a kind changed, or taken out where that gives None."""
    all_of_it = [change(m) if isinstance(m, kind) else m for m in rendered_flight().measurements]
    return [m for m in all_of_it if m is not None]


with_imu, with_frames = partial(changed, ImuSample), partial(changed, FrameSet)


def with_image(frames: FrameSet, image: np.ndarray) -> FrameSet:
    return FrameSet(frames.t_ns, (image.astype(np.uint8),))


def packed(sample: ImuSample) -> ImuSample:
    """As if ten readings came in a packet."""
    return replace(sample, t_ns=sample.t_ns // 50_000_000 * 50_000_000 + sample.t_ns % 50_000_000 // 1000)


def number_of(m: ImuSample) -> int:
    return round((m.t_ns - 100_000_000_000) / 5_000_000)


FLIGHT_NS = range(104_000_000_000, 104_600_000_000)
"""In the midst of the flight."""

PLANTED = {
    "accel_units": lambda: with_imu(lambda m: replace(m, accel_B=m.accel_B / 9.81)),
    "gravity_missing": lambda: with_imu(lambda m: replace(m, accel_B=m.accel_B - [9.81, 0, 0])),
    "gyro_units": lambda: with_imu(lambda m: replace(m, gyro_B=m.gyro_B * 57.3)),
    "gravity_size": lambda: with_imu(lambda m: replace(m, accel_B=m.accel_B * 1.3)),
    "imu_constant": lambda: with_imu(lambda m: replace(m, gyro_B=m.gyro_B * [1, 1, 0])),
    "stamps_zero": lambda: with_frames(lambda m: replace(m, t_ns=0)),
    "stamp_units": lambda: with_imu(lambda m: replace(m, t_ns=m.t_ns // 1000)),
    "clocks_apart": lambda: with_imu(lambda m: replace(m, t_ns=m.t_ns + 10**18)),
    "stamps_bunched": lambda: with_imu(packed),
    "imu_rate": lambda: [
        m for m in rendered_flight().measurements if isinstance(m, FrameSet) or number_of(m) % 10 == 0
    ],
    "imu_gaps": lambda: [
        m for m in rendered_flight().measurements if isinstance(m, FrameSet) or m.t_ns not in FLIGHT_NS
    ],
    "frame_gaps": lambda: with_frames(lambda m: None if m.t_ns in FLIGHT_NS else m),
    "imu_missing": lambda: with_imu(lambda m: None),
    "images_missing": lambda: with_frames(lambda m: None),
    "unreadable": lambda: with_frames(
        lambda m: Unreadable(m.t_ns, "frame_unreadable", "damaged") if m.t_ns % 2_000_000_000 == 0 else m
    ),
    "images_dark": lambda: with_frames(lambda m: with_image(m, m.images[0] // 16)),
    "images_bright": lambda: with_frames(lambda m: with_image(m, np.full_like(m.images[0], 255))),
}


def test_a_good_flight_is_found_good():
    found = looked_at()
    assert not found.wrong
    assert "200.0 Hz" in found.facts["IMU"]
    assert re.fullmatch(
        r"gyroscope (0\.9|1\.0|1\.1) times, accelerometer (0\.9|1\.0|1\.1) times .*", found.facts["vibration"]
    )
    assert "10.0 Hz" in found.facts["cam0"]


@pytest.mark.parametrize("kind", PLANTED)
def test_what_is_planted_is_named_first(kind):
    found = looked_at(PLANTED[kind]())
    assert found.findings[0].kind == kind, found.findings
    assert found.findings[0].severity is Severity.WRONG


def test_images_that_are_there_but_cannot_be_read_are_not_sought_elsewhere():
    found = looked_at(with_frames(lambda m: Unreadable(m.t_ns, "frame_unreadable", "damaged")))
    assert str(found.findings[0]).startswith("there are no images that can be read; copy the recording again")


@pytest.mark.parametrize(("end", "expected"), [(12.5, True), (99.0, False)])
def test_readings_at_the_end_of_a_range_are_told_from_large_ones(end, expected):
    shaken = with_imu(lambda m: replace(m, accel_B=np.minimum(m.accel_B * [1.25, 1, 1], end)))
    assert ("accel_saturated" in [f.kind for f in looked_at(shaken).findings]) == expected


def test_densities_that_do_not_fit_are_named_with_the_line_to_write():
    noise = CALIBRATION.imu
    found = looked_at(calibration=replace(CALIBRATION, imu=replace(noise, gyro_density=100 * noise.gyro_density)))
    assert found.findings[0].kind == "noise_density"
    assert found.findings[0].figures["density"] == pytest.approx(noise.gyro_density, rel=0.2)
    assert f"`gyroscope_noise_density: {found.findings[0].figures['density']:.2g}`" in found.findings[0].remedy


def test_images_that_repeat_count_only_while_the_body_turns():
    first = next(m for m in rendered_flight().measurements if isinstance(m, FrameSet))
    at_rest = with_frames(lambda m: replace(first, t_ns=m.t_ns) if m.t_ns < 101_000_000_000 else m)
    assert "images_frozen" not in [f.kind for f in looked_at(at_rest).findings]
    for_long = with_frames(lambda m: replace(first, t_ns=m.t_ns) if m.t_ns > 103_000_000_000 else m)
    assert looked_at(for_long).findings[0].kind == "images_frozen"


def test_one_stamp_from_far_off_makes_no_years_of_windows():
    gatherer = Gatherer(CALIBRATION)
    for m in rendered_flight().measurements:
        gatherer.add(m)
        if m.t_ns in FLIGHT_NS and isinstance(m, FrameSet):
            gatherer.add(replace(m, t_ns=-(10**14)))
    t_s, moving = moving_windows(gatherer.recording())
    assert len(t_s) == len(moving) < 100


def test_a_run_listens_for_its_first_part_only():
    gatherer = Gatherer(CALIBRATION, longest_s=2.0)
    for measurement in rendered_flight().measurements:
        gatherer.add(measurement)
    assert len(gatherer.recording().look.t_ns) == 21


def test_the_table_of_kinds_in_the_guide_is_that_of_the_code():
    guide = (Path(__file__).parents[1] / "docs" / "check.md").read_text(encoding="utf-8")
    assert "\n".join(f"| `{kind}` | {about} |" for kind, about in CAUSES.items()) in guide


def test_causes_come_ahead_of_what_follows_and_what_is_wrong_ahead_of_what_is_worth_knowing():
    cause = Finding("gyro_units", "rates are in deg/s", "multiply them")
    consequence = Finding("rotation", "it is off", "correct it")
    note = Finding("imu_rate", "it is slow", "raise it", Severity.WORTH_KNOWING)
    possible = replace(cause, certainty=Certainty.POSSIBLE)
    assert ranked([note, consequence, possible, cause]) == (cause, possible, consequence, note)


# ---- the command line


def vioframe_(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture
def in_g(tmp_path):
    """A recording whose accelerations are in g."""
    return rendered_flight().write(tmp_path / "flight.bag", PLANTED["accel_units"]())


def test_check_lists_what_is_wrong_and_says_so_by_its_exit_code(in_g):
    done = vioframe_("check", in_g, "--quiet", "--duration", 3)
    assert done.exit_code == 1
    assert "Accelerations are in g" in done.stdout
    assert "-> multiply them by 9.80" in done.stdout.replace("9.81", "9.80")


def test_check_gives_all_of_it_as_json(in_g):
    done = vioframe_("check", in_g, "--json", "--duration", 3)
    tree = json.loads(done.stdout)
    assert done.exit_code == 1
    assert tree["wrong"]
    assert (tree["findings"][0]["camera"], tree["findings"][0]["kind"]) == ("cam0", "accel_units")
    assert "specific force 0.98" in tree["facts"]["cam0"]["IMU"]
    assert tree["findings"][0]["figures"]["usual_length"] == pytest.approx(1.0, abs=0.05)


def test_a_live_source_is_listened_to_for_a_while(in_g):
    recorded = json.loads(vioframe_("check", in_g, "--json", "--duration", 3).stdout)
    # By its topic, which what was recorded of it has no more.
    done = vioframe_("check", f"replay:{in_g}", "--json", "--duration", 3, "--cameras", "/cam0/image_raw")
    assert done.exit_code == 1
    assert json.loads(done.stdout)["data"] == f"replay:{in_g}"
    heard = {(each["camera"], each["kind"]) for each in json.loads(done.stdout)["findings"]}
    assert heard == {(each["camera"], each["kind"]) for each in recorded["findings"]}
    assert "nothing:" not in vioframe_("check", "nothing:here").stdout


def test_images_that_do_not_fit_the_calibration_are_a_finding_too(tmp_path):
    flight = rendered_flight().write(tmp_path / "flight")
    calibration = tmp_path / "flight" / "mav0" / "cam0" / "sensor.yaml"
    calibration.write_text(calibration.read_text().replace("[376, 240]", "[752, 480]"))
    done = vioframe_("check", flight, "--quiet")
    assert done.exit_code == 1
    assert "Images are 376x240, the calibration is for 752x480" in done.stdout
    assert "`intrinsics: [114.500, 114.500" in done.stdout


def test_check_looks_at_the_cameras_asked_for_one_after_the_other(tmp_path):
    """What the IMU does wrong is said once, and each camera is held against its own calibration."""
    flight = rendered_flight().write(tmp_path / "flight", PLANTED["accel_units"]())
    mav0 = flight / "mav0"
    shutil.copytree(mav0 / "cam0", mav0 / "cam1")
    calibration = mav0 / "cam1" / "sensor.yaml"
    calibration.write_text(re.sub(r"timeshift_cam_imu: \S+", "timeshift_cam_imu: 0.06", calibration.read_text()))
    settings = ("--json", "--duration", 6)
    first, both = (
        json.loads(vioframe_("check", flight, *settings, "--cameras", names).stdout) for names in ("cam0", "cam1,cam0")
    )
    assert (list(first["facts"]), first["cameras_left_aside"]) == (["cam0"], ["cam1"])
    assert (list(both["facts"]), both["cameras_left_aside"]) == (["cam1", "cam0"], [])
    found = [(each["camera"], each["kind"]) for each in both["findings"]]
    assert [kind for _, kind in found].count("accel_units") == 1
    assert ("cam1", "time_offset") in found
    assert "time_offset" not in [each["kind"] for each in first["findings"]]


def test_check_puts_a_plug_in_through_the_conformance_kit():
    done = vioframe_("check", "shi_tomasi")
    assert done.exit_code == 0
    assert "detector 'shi_tomasi'" in done.stdout
    assert "keeps to all that is promised" in done.stdout


def test_check_of_a_name_that_is_nothing_says_what_it_might_be():
    done = vioframe_("check", "shi_tomas")
    assert done.exit_code == 2
    assert "did you mean 'shi_tomasi'" in done.stderr


def test_a_run_that_never_initialises_names_the_likeliest_cause_and_fails_also_when_quiet(in_g, tmp_path):
    done = vioframe_("run", in_g, "--out", tmp_path / "out", "--duration", 3, "--quiet")
    assert done.exit_code == 1
    assert "never initialised; likeliest cause: accelerations are in g" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    summary = RunFolder.open(tmp_path / "out").summary
    assert summary["findings"][0]["kind"] == "accel_units"
    assert any("too far from gravity's #" in reason for reason in summary["event_reasons"])


def test_clocks_apart_are_named_where_no_frame_can_be_processed(tmp_path):
    flight = rendered_flight().write(tmp_path / "flight.bag", PLANTED["clocks_apart"]())
    done = vioframe_("run", flight, "--out", tmp_path / "out", "--quiet")
    assert done.exit_code == 2
    assert "overlap nowhere" in done.stderr
