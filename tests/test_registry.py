"""Parts come in by entry point; whatever is wrong with one is said, and does not touch the others."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import pytest
from plugin_helpers import install

import vioframe
from vioframe.errors import ConfigError, DatasetError, PluginError
from vioframe.parts import hooks as hookspecs
from vioframe.parts import registry
from vioframe.parts.config import parse
from vioframe.parts.options import REQUIRED, options_of, plugin_factory, validate_options
from vioframe.pipeline import prepare

if TYPE_CHECKING:
    from vioframe.types import Calibration

DETECTOR = """
    class Blank:
        "Finds nothing."
        def __init__(self, size: int = 3, *, name: str = "x"): self.size, self.name = size, name
        def detect(self, image, max_points): ...
    @hookimpl
    def vioframe_detectors(): return {%s}
"""


def detector(names: str) -> str:
    return DETECTOR % names


@pytest.fixture
def add(tmp_path, monkeypatch):
    """Install a plug-in module; each gets a folder of its own."""

    def install_one(module: str, code: str, distribution: str | None = None, **more: str) -> None:
        folder = tmp_path / module
        folder.mkdir()
        name = distribution or module.replace("_", "-")
        install(folder, monkeypatch, distribution=name, module=module, code=code, **more)

    return install_one


def failure(loaded: registry.Registry, entry_point: str) -> str:
    return next(f.reason for f in loaded.failures if f.origin.entry_point == entry_point)


def test_every_built_in_comes_in_through_the_entry_points():
    loaded = registry.load()
    assert not loaded.failures
    classic = {"shi_tomasi", "fast", "orb", "sift", "akaze", "brisk", "surf", "random"}
    assert classic | {"superpoint"} <= set(loaded.names(registry.DETECTOR))
    assert "msckf" in loaded.names(registry.BACKEND)
    assert {"euroc", "rosbag"} <= set(loaded.names(registry.DATASET))
    assert {"hover", "figure_eight", "standstill"} <= set(loaded.names(registry.FLIGHT))


def test_without_entry_points_there_is_nothing():
    assert registry.load([]).parts == {kind.name: {} for kind in registry.KINDS}


def test_every_hook_has_a_kind():
    hooks = {name for name in vars(hookspecs) if name.startswith("vioframe_")}
    assert hooks == {kind.hook for kind in registry.KINDS}


def test_the_framework_imports_no_plugin():
    root = Path(vioframe.__file__).parent
    sources = [path.read_text() for path in root.rglob("*.py")]
    assert len(sources) > 30
    assert not [s for s in sources if "import vioframe_" in s or "from vioframe_" in s]


def test_a_third_party_part_is_found_and_created_with_coerced_options(add):
    add("blank_one", detector('"blank_one": Blank'), version="2.5")
    loaded = registry.load()
    part = loaded.find(registry.DETECTOR, "blank_one")
    assert str(part) == "detector 'blank_one' (blank-one 2.5)"
    made = loaded.create_detector("blank_one", {"size": "7"})
    assert (made.size, made.name) == (7, "x")


@pytest.mark.parametrize(
    ("module", "code", "why"),
    [
        ("no_torch", "import a_library_nobody_has", "ModuleNotFoundError: No module named 'a_library_nobody_has'"),
        ("raises_early", "raise RuntimeError('bad\\nday')", "RuntimeError: bad day"),
        ("not_python", "def (:", "SyntaxError"),
        ("misspelt", "@hookimpl\ndef vioframe_detector(): return {}", "did you mean 'vioframe_detectors'?"),
        ("undecorated", "def vioframe_detectors(): return {}", "implements no hook; decorate"),
        ("raises_late", "@hookimpl\ndef vioframe_detectors(): raise ValueError('late')", "ValueError: late"),
        ("not_callable", "@hookimpl\ndef vioframe_backends(): return {'x': 3}", "must map names to callables"),
        ("no_accepts", "@hookimpl\ndef vioframe_datasets(): return {'x': dict}", "'x' has no accepts(path)"),
        ("no_signature", "@hookimpl\ndef vioframe_detectors(): return {'x': dict}", "ValueError: no signature found"),
        ("a_list", "@hookimpl\ndef vioframe_detectors(): return ['x']", "vioframe_detectors() must return a dict"),
        (
            "no_given",
            "@hookimpl\ndef vioframe_loop_closers(): return {'x': lambda *, loops=3: 0}",
            "the loop closer 'x' must take the calibration ahead of its options",
        ),
        (
            "old_style",
            "@hookimpl\ndef vioframe_backends(): return {'x': lambda calibration, loops=3: 0}",
            "the backend 'x' asks for a calibration, which comes with begin(start)",
        ),
        ("wrong_arguments", "@hookimpl\ndef vioframe_backends(a): return {}", "PluginValidationError"),
    ],
)
def test_a_broken_plugin_is_skipped_with_the_reason(add, caplog, module, code, why):
    names = registry.load().names(registry.DETECTOR)
    add(module, code)
    with caplog.at_level(logging.WARNING):
        loaded = registry.load()
    assert why in failure(loaded, module)
    assert f"plug-in {module} ({module.replace('_', '-')} 1.0) is skipped" in caplog.text
    assert loaded.names(registry.DETECTOR) == names


def test_a_broken_plugin_does_not_trip_the_next(add):
    add("a_misspelt", "@hookimpl\ndef vioframe_detektors(): return {}")
    add("b_fine", detector('"b_fine": Blank'))
    loaded = registry.load()
    assert [f.origin.entry_point for f in loaded.failures] == ["a_misspelt"]
    assert "b_fine" in loaded.names(registry.DETECTOR)


def test_a_name_taken_twice_is_an_error_only_where_it_is_used(add):
    add("thief", detector('"orb": Blank'), version="0.3")
    loaded = registry.load()
    assert loaded.create_detector("sift")
    with pytest.raises(PluginError, match=r"several .* detector called 'orb'; say orb@vioframe or orb@thief"):
        loaded.create_detector("orb")
    assert loaded.create_detector("orb@thief", {"size": 5}).size == 5
    assert {"orb@thief", "orb@vioframe"} <= set(loaded.names(registry.DETECTOR))


def test_one_plugin_alone_has_its_part_by_its_own_name(add):
    add("thief", detector('"orb": Blank'), version="0.3")
    part = registry.load().find(registry.DETECTOR, "orb@thief")
    alone = registry.load_alone(part.origin)
    assert (part.own_name, alone.names(registry.DETECTOR)) == ("orb", ["orb"])
    assert alone.create_detector(part.own_name, {"size": 5}).size == 5
    assert not any(alone.names(kind) for kind in registry.KINDS if kind is not registry.DETECTOR)


def test_a_name_taken_twice_within_a_distribution_is_told_by_the_entry_points(add):
    for module in ("first_half", "second_half"):
        add(module, detector('"blank": Blank'))
    loaded = registry.load([EntryPoint(module, module, "vioframe") for module in ("first_half", "second_half")])
    assert loaded.names(registry.DETECTOR) == ["blank@first_half", "blank@second_half"]


def test_the_same_name_may_serve_two_kinds(add):
    add("both", detector('"euroc": Blank'))
    assert "euroc" in registry.load().names(registry.DETECTOR)


def test_an_unknown_name_lists_what_is_there_and_what_failed(add):
    add("gone_part", "import a_library_nobody_has")
    message = r"no detector is called 'shi_tomas' \(did you mean 'shi_tomasi'\?\); installed: akaze, .*gone_part"
    with pytest.raises(PluginError, match=message):
        registry.load().create_detector("shi_tomas")


def test_a_factory_that_fails_is_named(add):
    code = "@hookimpl\ndef vioframe_detectors(): return {'lame': lame}\ndef lame(): raise ImportError('no torch')"
    add("lame_part", code)
    message = r"detector 'lame' \(lame-part 1.0\) could not be created: ImportError: no torch"
    with pytest.raises(PluginError, match=message):
        registry.load().create_detector("lame")


def test_a_factory_that_makes_something_else_is_named(add):
    add("odd_part", "@hookimpl\ndef vioframe_detectors(): return {'odd': lambda: {}}")
    with pytest.raises(PluginError, match=r"'odd' .* made a dict, which has no detect"):
        registry.load().create_detector("odd")


def test_a_data_set_may_lack_ground_truth_but_not_the_attribute(add, tmp_path):
    code = """
    class Flight:
        name, calibration, frame_count, ground_truth = "f", None, None, None
        def __init__(self, path): ...
        def measurements(self): return iter(())
        accepts = staticmethod(lambda path: path.suffix == ".flight")
    class Half(Flight):
        accepts = staticmethod(lambda path: path.suffix == ".half")
        measurements = None
    class Less:
        def __init__(self, path): ...
        accepts = staticmethod(lambda path: path.suffix == ".less")
    @hookimpl
    def vioframe_datasets(): return {"flight": Flight, "less": Less}
    """
    add("flights", code)
    loaded = registry.load()
    for suffix in (".flight", ".less"):
        (tmp_path / f"a{suffix}").write_text("x")
    assert loaded.open_dataset(tmp_path / "a.flight").ground_truth is None
    with pytest.raises(PluginError, match="Less, which has no name, calibration, frame_count, ground_truth, measur"):
        loaded.open_dataset(tmp_path / "a.less")


def test_what_is_wrong_with_a_path_is_said(tmp_path):
    loaded = registry.load()
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos" / "holiday").mkdir(parents=True)
    (tmp_path / "empty.xyz").touch()
    (tmp_path / "talk.mp3").write_text("not a bag")
    for name, why in [
        ("missing.bag", "does not exist"),
        ("empty", "is an empty folder"),
        ("photos", "is a folder without mav0/"),
        ("empty.xyz", "is an empty file"),
        ("talk.mp3", "its extension is '.mp3'"),
    ]:
        with pytest.raises(DatasetError, match=why):
            loaded.open_dataset(tmp_path / name)


def test_two_readers_for_one_path_ask_for_a_choice(add, tmp_path):
    code = """
    class Rival:
        def __init__(self, path): ...
        accepts = staticmethod(lambda path: (path / "mav0").is_dir())
    @hookimpl
    def vioframe_datasets(): return {"rival": Rival}
    """
    add("rival_reader", code)
    (tmp_path / "flight" / "mav0").mkdir(parents=True)
    with pytest.raises(DatasetError, match=r"several readers accept .*: euroc, rival; choose one with --reader"):
        registry.load().resolve(tmp_path / "flight")
    assert registry.load().resolve(tmp_path / "flight", "rival")[0].name == "rival"
    config = parse({"dataset": {"path": str(tmp_path / "flight"), "reader": "rival"}}, "test")
    with pytest.raises(PluginError, match="'rival'"):  # which was asked for, and is no data set
        prepare(config, registry.load())


def test_a_reader_that_fails_to_look_is_passed_over(add, tmp_path, caplog):
    code = """
    class Clumsy:
        def __init__(self, path): ...
        accepts = staticmethod(lambda path: 1 / 0)
    @hookimpl
    def vioframe_datasets(): return {"clumsy": Clumsy}
    """
    add("clumsy_reader", code)
    (tmp_path / "flight" / "mav0").mkdir(parents=True)
    assert registry.load().resolve(tmp_path / "flight")[0].name == "euroc"
    assert "'clumsy'" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_blame_finds_the_plugin_an_exception_came_from(add):
    code = """
    class Faulty:
        def detect(self, image, max_points): return {}["deep"]
    @hookimpl
    def vioframe_detectors(): return {"faulty": Faulty}
    """
    add("faulty_part", code)
    loaded = registry.load()
    with pytest.raises(KeyError) as raised:
        loaded.create_detector("faulty").detect(None, 1)
    assert loaded.blame(raised.value.__traceback__).distribution == "faulty-part"
    with pytest.raises(ValueError, match="invalid literal") as raised:
        int("x")
    assert loaded.blame(raised.value.__traceback__) is None


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Some."""

    window: int = 11
    """How many poses
    are kept."""
    mode: Literal["fast", "slow"] = "fast"
    weights: Annotated[Path | None, "the trained network"] = None

    def __post_init__(self) -> None:
        if self.window < 3:
            raise ValueError("window must be at least 3")


def build(calibration: Calibration, options: Options) -> tuple[object, Options]:
    """Builds it."""
    return calibration, options


def test_options_come_from_a_signature_with_its_names_types_defaults_and_help():
    def factory(calibration: Calibration, level: Annotated[float, "how much"], *, on: bool = True) -> None: ...

    level, on = options_of(factory, given=1)
    assert (level.name, level.type_name, level.default, level.doc) == ("level", "float", REQUIRED, "how much")
    assert (on.name, on.type_name, on.default, on.doc) == ("on", "bool", True, "")


def test_a_dataclass_serves_as_the_options_of_a_factory():
    factory = plugin_factory(build, Options)
    assert factory("calibration", window=5) == ("calibration", Options(window=5))
    assert factory.__doc__ == "Builds it."
    assert [(o.name, o.default, o.doc) for o in options_of(factory, given=1)] == [
        ("window", 11, "How many poses are kept."),
        ("mode", "fast", ""),
        ("weights", None, "the trained network"),
    ]
    assert validate_options("it", factory, {"window": "7", "weights": "a.ckpt"}, given=1) == {
        "window": 7,
        "mode": "fast",
        "weights": Path("a.ckpt"),
    }


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"windw": 3}, r"it has no option 'windw' \(did you mean 'window'\?\); its options: window: int = 11, mode"),
        ({"window": "many"}, r"it: window='many': Input should be a valid integer.*its options: window: int = 11"),
        ({"mode": "medium"}, r"it: mode='medium': Input should be 'fast' or 'slow'"),
        ({"window": 2}, r"it: window must be at least 3"),
    ],
)
def test_a_bad_option_shows_the_options_there_are(values, why):
    with pytest.raises(ConfigError, match=why):
        validate_options("it", plugin_factory(build, Options), values, given=1)


def test_an_option_without_default_is_asked_for():
    def factory(weights: Annotated[Path, "a trained network"]) -> None: ...

    message = r"it needs the option 'weights' \(a trained network\): pass -o weights=\.\.\."
    with pytest.raises(ConfigError, match=message):
        validate_options("it", factory, {})
