"""The project itself: the example plug-in is a real distribution, and the parts that ship keep their promises."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from zipfile import ZipFile

import pytest
from click.testing import CliRunner

from vioframe.parts import registry
from vioframe.parts.options import REQUIRED
from vioframe.testing import check_backend, check_dataset, check_detector
from vioframe.types import FrameSet

ROOT = Path(__file__).resolve().parents[1]
INSTALLED = registry.load()


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    """The environment of a Python into which the example plug-ins were installed by pip, without a network."""
    site = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    folders = [ROOT / "docs" / name for name in ("example-plugin", "example-backend")]
    subprocess.run([*pip, "--target", site, *folders], check=True)
    search = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": search, "COLUMNS": "200"}


def call(environment, *arguments, code=None):
    """What Python prints, of the module that the arguments begin with, or of ``code``."""
    what = ["-m"] if code is None else ["-c", code]
    done = subprocess.run([sys.executable, *what, *arguments], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout


@pytest.mark.parametrize(
    ("kind", "name", "distribution"),
    [("detector", "harris", "vioframe-harris"), ("backend", "tiny_msckf", "vioframe-tiny-msckf")],
)
def test_the_example_plugins_are_found_once_installed(examples, kind, name, distribution):
    (row,) = [line for line in call(examples, "vioframe", "plugins").splitlines() if f" {name} " in line]
    assert row.split()[:4] == [kind, name, distribution, "0.1.0"]


def test_the_options_of_the_examples_are_known(examples):
    assert "weakest corner kept, relative to the strongest" in call(examples, "vioframe", "plugins", "harris")
    config = call(examples, "vioframe", "config", "--detector", "harris", "--backend", "tiny_msckf")
    assert "min_distance_px: 8.0" in config
    assert "window: 8" in config


@pytest.mark.parametrize("test", ["example-plugin/test_harris.py", "example-backend/test_tiny_msckf.py"])
def test_the_example_plugins_pass_their_own_tests(examples, test):
    path = str(ROOT / "docs" / test)
    assert "1 passed" in call(examples, "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, path)


def test_every_benchmark_finds_what_it_imports():
    """Each is a script, run by nobody between two records."""
    folder = ROOT / "benchmarks"
    scripts = [path.stem for path in sorted(folder.glob("*.py"))]
    assert "rendered_flights" in scripts
    search = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    importing = "import importlib, sys; [importlib.import_module(name) for name in sys.argv[1:]]"
    call({**os.environ, "PYTHONPATH": search}, *scripts, code=importing)


def test_a_benchmark_says_in_one_line_what_is_wrong(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import exact_points

    done = CliRunner().invoke(exact_points.main, [str(tmp_path)])
    assert done.exit_code == 2
    (line,) = done.output.splitlines()
    assert line.startswith("error: ")
    assert "suite.yaml" in line


@pytest.mark.parametrize("name", INSTALLED.names(registry.DETECTOR))
def test_every_detector_conforms(name):
    part = INSTALLED.find(registry.DETECTOR, name)
    needed = [option.name for option in part.options if option.default is REQUIRED]
    if needed:
        pytest.skip(f"it needs what does not ship ({', '.join(needed)}); its own tests check it")
    check_detector(part.factory)


@pytest.mark.parametrize("name", INSTALLED.names(registry.BACKEND))
def test_every_backend_conforms(name):
    check_backend(INSTALLED.find(registry.BACKEND, name).factory)


def test_the_folder_reader_conforms(shared_data):
    check_dataset(INSTALLED.find(registry.DATASET, "euroc").factory, shared_data / "euroc" / "V1_01_easy_rest")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder], cwd=ROOT, check=True)
    (path,) = folder.glob("vioframe-*.whl")
    return path


def test_the_wheel_holds_what_an_installation_needs(wheel):
    names = set(ZipFile(wheel).namelist())
    assert "vioframe/py.typed" in names
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    code = [name for name in tracked if name.startswith(("vioframe/", "plugins/"))]
    moved = {"benchmarks/suites/": "vioframe/data/suites/", "benchmarks/thesis/": "vioframe/data/thesis/"}
    data = [name.replace(old, new) for name in tracked for old, new in moved.items() if name.startswith(old)]
    assert len(code) > 100
    assert len(data) > 5
    missing = [name for name in [*(name.removeprefix("plugins/") for name in code), *data] if name not in names]
    assert missing == []
    assert [name for name in names if name.startswith(("tests/", "docs/", "benchmarks/"))] == []


def test_the_wheel_works_where_it_is_installed(wheel, tmp_path):
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", tmp_path]
    subprocess.run([*pip, wheel], check=True)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def printed(*arguments):
        run = [sys.executable, *arguments]
        return subprocess.run(run, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True).stdout

    where = printed("-c", "import vioframe; print(vioframe.__file__)")
    assert Path(where.strip()).is_relative_to(tmp_path)
    assert "mh05_comparison" in printed("-m", "vioframe", "bench", "--help")


def test_every_requirement_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = {re.split(r"[^\w.-]", r)[0] for r in [*project["dependencies"], *extras["test"], *extras["open3d"]]}
    pins = [line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if line[0] != "#"]
    assert all(len(pin) == 2 for pin in pins)
    assert wanted - {"vioframe"} <= {name for name, _ in pins}


def test_every_builtin_plugin_is_declared():
    modules = {path.stem for path in (ROOT / "plugins").iterdir() if path.name.startswith("vioframe_")}
    entries = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["vioframe"]
    assert set(entries.values()) == modules


def test_a_flight_to_plant_a_fault_into_is_rendered_as_asked(monkeypatch):
    """What the record of planted faults begins with, which takes minutes."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import planted_faults

    monkeypatch.setattr(planted_faults, "_DURATION_S", 0.2)
    flight = planted_faults.flight_named("fisheye", ROOT, seed=1)
    (camera,) = flight.calibration.cameras
    assert camera.model.distortion_model == "equidistant"
    assert len([m for m in flight.measurements if isinstance(m, FrameSet)]) == 5
