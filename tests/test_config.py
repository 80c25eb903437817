"""Configurations: complete, checked to the last key, and the same after a round trip through YAML."""

import pytest

from vioframe.errors import ConfigError, VioframeError
from vioframe.parts import config, registry
from vioframe.parts.config import Config
from vioframe.parts.options import options_of


@pytest.fixture(scope="module")
def installed() -> registry.Registry:
    return registry.load()


@pytest.fixture
def flight(tmp_path):
    (tmp_path / "flight" / "mav0").mkdir(parents=True)
    return tmp_path / "flight"


def with_data(path) -> Config:
    return config.parse({"dataset": {"path": path}})


def test_the_complete_configuration_survives_yaml(installed, flight, tmp_path):
    before = config.complete(with_data(flight), installed)
    text = config.render(before, installed)
    (tmp_path / "c.yaml").write_text(text)
    after = config.complete(config.read(tmp_path / "c.yaml"), installed)
    assert after == before
    assert config.render(after, installed) == text


def test_the_name_of_a_part_is_enough(tmp_path):
    (tmp_path / "c.yaml").write_text("detector: orb\nloop_closure: pose_graph\n")
    read = config.read(tmp_path / "c.yaml")
    assert (read.detector, read.backend) == (config.PartConfig(name="orb"), Config().backend)
    assert read.loop_closure == config.PartConfig(name="pose_graph")


def test_a_complete_configuration_holds_every_option_of_every_part(installed, flight):
    done = config.complete(with_data(flight), installed)
    assert set(done.backend.options) == {o.name for o in installed.find(registry.BACKEND, "msckf").options}
    assert set(done.detector.options) == {o.name for o in installed.find(registry.DETECTOR, "shi_tomasi").options}
    assert set(done.frontend) == {o.name for o in options_of(config.FrontendOptions)}
    assert set(done.estimation) == {o.name for o in options_of(config.EstimationOptions)}
    assert set(done.dataset.options) == {o.name for o in installed.find(registry.DATASET, "euroc").options}
    assert done.dataset.reader == "euroc"


def test_each_option_is_shown_with_its_help(installed):
    text = config.render(config.complete(Config(), installed), installed)
    window = next(o for o in installed.find(registry.BACKEND, "msckf").options if o.name == "max_clones")
    assert f"    # {window.doc}\n    max_clones: {window.default}\n" in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("detecter: orb", r"unknown key 'detecter' \(did you mean 'detector'\?\); keys here: dataset, detector"),
        ("backend: {name: msckf, optoins: {}}", r"unknown key 'backend\.optoins' \(did you mean 'options'\?\)"),
        ("backend: {options: {}}", r"backend\.name: Field required"),
        ("start_s: soon", r"start_s: Input should be a valid number.*got 'soon'"),
        ("start_s: -1", "start_s: Input should be greater than or equal to 0"),
        ("duration_s: 0", "duration_s: Input should be greater than 0"),
        ("duration_s: .nan", "duration_s: Input should be a finite number"),
        ("wait_ms: -1", "wait_ms: Input should be greater than or equal to 0"),
        ("[1, 2]", "must hold keys and values"),
        ("a: b: c", "is not valid YAML"),
        ("start_s: 1\nstart_s: 2", "is not valid YAML: .*duplicate key"),
    ],
)
def test_a_bad_file_is_refused_with_the_place(tmp_path, text, why):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=why) as raised:
        config.read(tmp_path / "c.yaml")
    assert "c.yaml" in str(raised.value)


@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"detector": {"name": "orbb"}}, r"no detector is called 'orbb' \(did you mean 'orb'\?\)"),
        ({"backend": {"name": "msckf", "options": {"max_clone": 3}}}, r"'max_clone' \(did you mean 'max_clones'\?\)"),
        ({"frontend": {"max_pionts": 3}}, r"the front-end has no option 'max_pionts' \(did you mean 'max_points'\?\)"),
        ({"frontend": {"max_points": "many"}}, r"the front-end: max_points='many': Input should be a valid integer"),
        ({"frontend": {"max_points": 0}}, "max_points must be at least 1"),
        ({"estimation": {"gyro_noise": 3}}, r"the estimation has no option 'gyro_noise' \(did you mean 'gyro_noise_f"),
        ({"estimation": {"gyro_noise_factor": float("nan")}}, "gyro_noise_factor must be more than zero, got nan"),
        ({"estimation": {"accel_walk_factor": 0}}, "accel_walk_factor must be more than zero"),
        ({"estimation": {"max_blind_s": 0}}, "max_blind_s must be more than zero"),
        ({"estimation": {"standstill_disparity_px": -1}}, "standstill_disparity_px must be zero or more"),
        ({"dataset": {"path": "nowhere.bag"}}, r"nowhere\.bag does not exist"),
    ],
)
def test_what_only_the_parts_know_is_checked_against_them(installed, tree, why):
    with pytest.raises(VioframeError, match=why):
        config.complete(config.parse(tree), installed)


def test_a_missing_or_binary_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the configuration"):
        config.read(tmp_path / "none.yaml")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot read the configuration"):
        config.read(tmp_path / "b.yaml")


def test_an_empty_file_is_the_default(tmp_path):
    (tmp_path / "c.yaml").write_text("# nothing chosen\n")
    assert config.read(tmp_path / "c.yaml") == Config()


def test_overrides_reach_the_part_they_name_or_the_only_one_that_has_the_key(installed, flight):
    assignments = ["backend.max_clones=20", "max_points=99", "detector.min_distance_px=3.5", "cameras=cam1"]
    done = config.complete(config.override(with_data(flight), installed, assignments), installed)
    assert done.backend.options["max_clones"] == 20
    assert done.frontend["max_points"] == 99
    assert done.detector.options["min_distance_px"] == 3.5
    assert done.frontend["min_distance_px"] != 3.5
    assert done.dataset.options["cameras"] == "cam1"


def test_override_values_are_yaml_where_the_option_wants_it_and_text_where_not(installed, flight):
    assignments = ["cameras=[cam1]", "zero_velocity_update=false", "bit_depth=null", "imu=2", "equalisation=none"]
    done = config.complete(config.override(with_data(flight), installed, assignments), installed)
    assert done.estimation["zero_velocity_update"] is False
    assert done.frontend["equalisation"] == "none"
    assert done.dataset.options["bit_depth"] is None
    assert done.dataset.options["cameras"] == ["cam1"]
    assert done.dataset.options["imu"] == "2"


def test_overriding_leaves_the_original_alone(installed, flight):
    before = with_data(flight)
    config.override(before, installed, ["max_clones=20", "cameras=cam1"])
    assert before == with_data(flight)


@pytest.mark.parametrize(
    ("assignment", "why"),
    [
        ("max_clones", "-o takes key=value, got 'max_clones'"),
        ("=3", "-o takes key=value"),
        ("min_distance_px=3", r"is ambiguous: write one of detector\.min_distance_px, frontend\.min_distance_px"),
        ("max_clone=3", r"no part has such an option \(did you mean 'max_clones'\?\)"),
        ("backend.max_clone=3", r"no part has such an option \(did you mean 'backend\.max_clones'\?\)"),
        ("backned.max_clones=3", r"no section 'backned' \(did you mean 'backend'\?\); sections: detector, backend"),
        ("weights=v4.ckpt", r"no part has such an option; options: detector\.quality_level, "),
    ],
)
def test_an_override_that_fits_nothing_is_refused(installed, flight, assignment, why):
    with pytest.raises(ConfigError, match=why):
        config.override(with_data(flight), installed, [assignment])
