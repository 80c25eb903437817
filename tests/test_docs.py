"""The documentation keeps its promises: links lead somewhere, and what can be counted is all there."""

import re
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from vioframe import hookspecs
from vioframe.cli import main

ROOT = Path(__file__).resolve().parents[1]
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
    commands = set(re.findall(r"^vioframe (\w+)", (ROOT / "README.md").read_text(), re.MULTILINE))
    assert {"run", "evaluate", "plot"} <= commands
    for command in commands:
        assert CliRunner().invoke(main, [command, "--help"]).exit_code == 0


def test_the_changelog_is_of_this_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"[{version}]" in (ROOT / "CHANGELOG.md").read_text()
