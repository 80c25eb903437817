"""The documentation keeps its promises: links lead somewhere, and what can be counted is all there."""

import json
import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from conftest import SHARED_DATA
from rendered_flight import rendered_flight
from ruamel.yaml import YAML

from vioframe.cli import main
from vioframe.io.trajectories import tum_line
from vioframe.parts import hooks as hookspecs
from vioframe.parts import registry
from vioframe.testing import check_detector

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
TABLES = runpy.run_path(str(ROOT / "benchmarks" / "make_tables.py"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for target, heading in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)]+))?\)", page.read_text()):
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), f"{page.name} links to {target}"
        if heading:
            headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
            assert heading in {re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in headings}


def test_every_hook_is_explained():
    text = (ROOT / "docs" / "plugins.md").read_text()
    hooks = [name for name in vars(hookspecs) if name.startswith("vioframe_")]
    assert hooks
    assert [name for name in hooks if f"`{name}`" not in text] == []


def test_every_incident_is_explained():
    sources = [path.read_text() for part in ("vioframe", "plugins") for path in (ROOT / part).rglob("*.py")]
    patterns = (r'incidents\.add\(\s*"(\w+)"', r'Unreadable\([^"]*"(\w+)"')
    kinds = {kind for text in sources for pattern in patterns for kind in re.findall(pattern, text)}
    assert {"imu_gap", "featureless_image", "detector_failed", "frame_unreadable"} <= kinds
    text = (ROOT / "docs" / "data.md").read_text()
    assert [kind for kind in sorted(kinds) if f"`{kind}`" not in text] == []


def test_commands_of_the_readme_exist():
    commands = set(re.findall(r"^vioframe (\w+)", README, re.MULTILINE))
    assert {"run", "evaluate", "plot"} <= commands
    for command in commands:
        assert CliRunner().invoke(main, [command, "--help"]).exit_code == 0


def test_the_command_line_reference_is_up_to_date():
    write = runpy.run_path(str(ROOT / "docs" / "make_cli_reference.py"))["page"]
    assert (ROOT / "docs" / "cli.md").read_text() == write(), "run python docs/make_cli_reference.py"


def test_every_part_that_ships_is_explained():
    tables = registry.load().parts.values()
    own = [part.name for table in tables for part in table.values() if part.origin.distribution == "vioframe"]
    explained = re.findall(r"^### [\w ]+ `(\w+)`$", (ROOT / "docs" / "cli.md").read_text(), re.MULTILINE)
    assert sorted(explained) == sorted(own)


def test_the_detector_of_the_readme_works():
    (code,) = re.findall(r"^```python\n(# mine\.py.*?)^```$", README, re.MULTILINE | re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    check_detector(names["vioframe_detectors"]()["agast"])


def test_the_readme_comes_to_the_point():
    """Install, one command on one's own recording, Python, how good it is: on the first screens."""
    before, _, _ = README.partition("\n## Read on\n")
    assert len(before.splitlines()) <= 60
    assert before.index("pip install") < before.index("vioframe run my.bag") < before.index("import vioframe")


@pytest.mark.slow
def test_the_python_example_of_the_readme_is_what_the_command_line_does(tmp_path, request):
    data = _recording(tmp_path, request)
    assert CliRunner().invoke(main, ["run", str(data), "--out", str(tmp_path / "run"), "--quiet"]).exit_code == 0
    (code,) = re.findall(r"^```python\n(import vioframe\n.*?)^```$", README, re.MULTILINE | re.DOTALL)
    code, there = re.subn(r'open_dataset\("MH_01_easy.bag"', f'open_dataset("{data}"', code)
    assert there == 1
    steps: list[Any] = []
    exec(code, {"print": lambda *values: steps.append(values)})
    lines = [tum_line(t_ns, s.R_WB, s.p_WB) for t_ns, _, s in steps if s is not None]
    assert len(lines) > 50
    written = (tmp_path / "run" / "trajectory.tum").read_text().splitlines()
    assert [line.rstrip() for line in lines] == [line for line in written if not line.startswith("#")]


def _recording(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Real images where they are at hand; else a short flight through dots of light."""
    if (real := SHARED_DATA / "euroc" / "MH_01_easy_15s").is_dir():
        return real
    return rendered_flight().write(tmp_path / "flight.bag")


def test_every_figure_in_print_is_that_of_a_record():
    for page in PAGES:
        text = page.read_text()
        blocks = TABLES["BLOCK"].findall(text)
        assert len(blocks) == text.count("<!-- figures") == text.count("<!-- end -->")
        assert (page in TABLES["PAGES"]) == bool(blocks)
        assert TABLES["page"](text) == text, "run python benchmarks/make_tables.py"
    shown = {name for page in TABLES["PAGES"] for _, name, _ in TABLES["BLOCK"].findall(page.read_text())}
    assert shown == set(TABLES["FIGURES"])


def test_no_figure_of_the_readme_is_typed_by_hand():
    prose = TABLES["BLOCK"].sub("", README)
    assert re.findall(r"\d (?:mm|cm|m|ms|%|FPS|deg)\b", prose) == []


def test_speeds_are_shown_for_each_kind_of_images_and_so_is_who_is_faster(tmp_path, monkeypatch):
    """One is faster on photographs, where its slower quartile is above the other's quicker one, and on nothing else."""

    def row(detector, images, fps):
        quartiles = {"fps": fps, "fps_low": 0.9 * fps, "fps_high": 1.1 * fps}
        return {"detector": detector, "images": images, **quartiles, "on": "cpu"}

    fps = {"drawn": (100.0, 110.0), "photographs": (50.0, 80.0), "frames": (70.0, 20.0)}
    rows = [row(*each) for kind, (a, b) in fps.items() for each in (("shi_tomasi", kind, a), ("other", kind, b))]
    record = {"results": rows, "settings": {}, "machine": {"commit": "0" * 40}, "recorded": "2026-01-01T00:00:00"}
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "detectors_speed.json").write_text(json.dumps(record))
    monkeypatch.setitem(TABLES["speed"].__globals__, "HERE", tmp_path)
    lines = TABLES["speed"]().splitlines()
    assert lines[0] == "| detector | drawn | photographs | frames | faster than `shi_tomasi` on | on |"
    assert lines[2:4] == [
        "| `other` | 110 (9.1 ms) | 80 (12 ms) | 20 (50 ms) | photographs | cpu |",
        "| `shi_tomasi` | 100 (10 ms) | 50 (20 ms) | 70 (14 ms) | - | cpu |",
    ]


@pytest.mark.parametrize("name", ["detectors", "bench_detectors", "keypointnet"])
def test_no_figure_of_a_detector_is_typed_by_hand(name):
    """Sizes in pixels and limits in per cent are settings; shares, times and their ratios are measured."""
    prose = TABLES["BLOCK"].sub("", (ROOT / "docs" / f"{name}.md").read_text())
    prose = re.sub(r"```.*?```|`[^`]*`", "", prose, flags=re.DOTALL)
    measured = r"\b0\.\d\d+|\b0\.[1-9] px|\d+ ?(?:ms|FPS|fps|frames/s|(?:frames|images) a second)\b|\d times\b"
    assert re.findall(measured, prose) == []


def test_nothing_says_what_the_quoted_speeds_were_measured_on():
    """Nobody knows: the thesis does not say."""
    quoted = YAML(typ="safe", pure=True).load(ROOT / "benchmarks" / "thesis" / "thesis.yaml")["speed"]["detectors"]
    assert quoted["keypointnet"]["fps"] == 184
    assert [name for name, each in quoted.items() if not each["source"].endswith("hardware not stated")] == []
    suffixes = {".md", ".yaml", ".py", ".j2", ".html", ".js"}
    rooms = ("docs", "benchmarks", "vioframe", "plugins")
    files = [*PAGES, *(path for room in rooms for path in (ROOT / room).rglob("*") if path.suffix in suffixes)]
    about = re.compile(r"thesis|\b184\b", re.IGNORECASE)
    device = re.compile(r"\bGPUs?\b|\bCUDA\b|graphics card|NVIDIA|GeForce|\bRTX\b|Jetson", re.IGNORECASE)
    paragraphs = ((path, text) for path in files for text in path.read_text(encoding="utf-8").split("\n\n"))
    assert [(path, text) for path, text in paragraphs if about.search(text) and device.search(text)] == []


def test_every_detector_that_took_part_is_in_the_table():
    record = json.loads((ROOT / "benchmarks" / "results" / "detectors_quality.json").read_text())
    took_part = {row["detector"] for row in record["results"] if "absent" not in row}
    assert len(took_part) >= 10
    assert [name for name in took_part if f"`{name}`" not in TABLES["quality"]()] == []


def test_every_page_is_in_the_site():
    nav = YAML(typ="safe", pure=True).load(ROOT / "mkdocs.yml")["nav"]
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert sorted(re.findall(r"[\w/]+\.md", str(nav))) == sorted(pages)


def test_changelog_and_citation_are_of_this_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"[{version}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
