"""Writes the tables of detectors into the pages that show them, from what was recorded in results/.

A page says where, between two comments: ``<!-- table: quality -->`` and ``<!-- end of table -->``. A test holds
them equal.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pandas as pd

from vioframe.bench.detectors.degradations import Degradation
from vioframe.bench.detectors.tables import by_degradation

HERE = Path(__file__).resolve().parent
PAGES = (HERE / "README.md", HERE.parent / "docs" / "keypointnet.md")
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def speed() -> str:
    """Every detector, the fastest first."""
    rows = recorded("speed").sort_values("fps", ascending=False)
    shown = {
        "detector": [f"`{name}`" for name in rows["detector"]],
        "images a second": [f"{fps:.0f}" for fps in rows["fps"]],
        "ms": [f"{ms:.1f}" if ms < 10.0 else f"{ms:.0f}" for ms in rows["ms"]],
        "on": rows["on"],
    }
    return markdown(pd.DataFrame(shown))


def quality() -> str:
    """Repeatability of every detector under every degradation, the best in bold."""
    rows = recorded("quality").drop(columns=["lead_repeatability"])
    table = by_degradation(rows, "repeatability", ".3f").set_index("degradation")
    best = table.astype(float).eq(table.astype(float).max(axis=1), axis=0)
    table = table.where(~best, "**" + table + "**").rename(columns=lambda name: f"`{name}`")
    return markdown(table.reset_index().rename(columns={"degradation": ""}))


def clean() -> str:
    """Every detector on images as they are."""
    rows = recorded("quality")
    rows = rows[rows["degradation"] == Degradation().name].sort_values("repeatability", ascending=False)
    shown = {
        "": [f"`{name}`" for name in rows["detector"]],
        "repeatability": rows["repeatability"].map("{:.3f}".format),
        "of distinct points": rows["distinct"].map("{:.3f}".format),
        "localisation px": rows["localisation_px"].map("{:.2f}".format),
    }
    return markdown(pd.DataFrame(shown))


def recorded(question: str) -> pd.DataFrame:
    """What ``results/detectors_QUESTION.json`` holds of those that took part."""
    content = json.loads((HERE / "results" / f"detectors_{question}.json").read_text(encoding="utf-8"))
    return pd.DataFrame([row for row in content["results"] if "absent" not in row])


def markdown(table: pd.DataFrame) -> str:
    lines = [list(table.columns), ["---"] * len(table.columns), *table.to_numpy().tolist()]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def page(text: str) -> str:
    """``text`` with every table made anew."""
    tables = {"speed": speed, "quality": quality, "clean": clean}
    return BLOCK.sub(lambda block: block[1] + tables[block[2]]() + block[3], text)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(page(path.read_text(encoding="utf-8")), encoding="utf-8")
