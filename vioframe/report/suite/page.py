"""The report as one HTML file that needs nothing else: no network, no server. How to read it: ``docs/report.md``."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any
from urllib.parse import quote

from vioframe.errors import PluginError
from vioframe.report.suite.page_blocks import Plot
from vioframe.report.suite.page_headline import headline
from vioframe.report.suite.page_look import DARK
from vioframe.report.suite.page_sections import filters, look_of, sections
from vioframe.report.suite.results import SuiteResults

FILE = "index.html"


def write_page(results: SuiteResults, out: Path) -> Path:
    """Write ``index.html`` into ``out``; its links are relative, so that the results can be moved along with it.

    Raises :class:`PluginError` where the extra that it needs is not installed.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
        from markupsafe import Markup
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError as error:
        raise PluginError(f'the report\'s page needs {error.name}: pip install "vioframe[bench]"') from None

    loader = PackageLoader(str(__package__))
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # Where a browser may fold what is one word to it: names with options, paths.
    environment.filters["foldable"] = lambda text: Markup("<wbr>").join(re.split(r"(?<=[,:/=])", text))
    look = look_of(results)
    to_results = Path(os.path.relpath(results.path.absolute(), out.absolute())).as_posix()
    made = sections(results, look, quote(to_results))
    plots = [block for section in made for block in section.blocks if isinstance(block, Plot)]

    def as_is(name: str) -> Markup:
        return Markup(loader.get_source(environment, name)[0])

    html = environment.get_template("page.html.j2").render(
        title=results.suite.get("title") or results.suite.get("name") or results.path.resolve().name,
        description=results.suite.get("description") or "",
        headline=headline(results),
        sections=made,
        filters=filters(results, look),
        plots={plot.id: _for_script(plot) for plot in plots},
        colours=DARK,
        css=as_is("page.css"),
        script=as_is("page.js"),
        plotly=Markup(get_plotlyjs()),
    )
    out.mkdir(parents=True, exist_ok=True)
    path = out / FILE
    path.write_text(html, encoding="utf-8")
    return path


def _for_script(plot: Plot) -> dict[str, Any]:
    """What the page's script reads of a plot; the rest is laid out by the template."""
    cases = [
        {
            "pictures": [{"data": picture.data, "layout": picture.layout} for picture in case.pictures],
            "caption": case.caption,
        }
        for case in plot.cases.values()
    ]
    return {"cases": cases, "narrow_height": plot.narrow_height, "height": plot.height, "views": plot.views}
