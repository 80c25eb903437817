"""Distributions made up on the spot: a folder with a module and the metadata that pip would have written."""

from pathlib import Path
from textwrap import dedent

import pytest


def install(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *, distribution: str, module: str, code: str, version: str = "1.0"
) -> None:
    """Make ``module`` importable, and declared as a plug-in of ``distribution``."""
    info = folder / f"{distribution}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[vioframe]\n{module} = {module}\n")
    (folder / f"{module}.py").write_text("from vioframe.parts.hooks import hookimpl\n" + dedent(code))
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(__import__("sys").modules, module, raising=False)
