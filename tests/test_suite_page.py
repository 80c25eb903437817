"""The page of a suite's report: what it says and links to, and what it does in a browser."""

import json
import re
import shutil
import sys
from base64 import b64decode
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from suite_helpers import MadeUp, comparison, labels, stress

from vioframe.errors import PluginError
from vioframe.report.suite.figures import figures
from vioframe.report.suite.page import facts, headline, write_page
from vioframe.report.suite.report import write_report
from vioframe.report.suite.statistics import records
from vioframe.report.suite.tables import tables
from vioframe.runs.results import Data

ENTER = "\ue007"
"""The key, to WebDriver."""
NASTY = "A </script><script>document.title = 'run'</script> & \"suite\""


class Elements(HTMLParser):
    """Tags with their attributes, and the text outside of scripts and styles."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.found[-1:] and self.found[-1][0] not in ("script", "style"):
            self.text += data

    def all(self, attribute: str) -> list[str]:
        return [value for _, attributes in self.found if (value := attributes.get(attribute)) is not None]


def write(made: MadeUp) -> Path:
    study = made.study()
    path = made.path / "report" / "index.html"
    return write_page(study, tables(study), figures(study), path, "..")


def said_by(made: MadeUp) -> list[str]:
    return list(headline(made.study()))


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> MadeUp:
    return comparison(tmp_path_factory.mktemp("page") / "compared with spaces")


@pytest.fixture(scope="module")
def page(compared: MadeUp) -> Path:
    return write(compared)


@pytest.fixture(scope="module")
def stressed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(stress(tmp_path_factory.mktemp("page") / "stressed"))


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of speed and trials, without any flight."""
    made = MadeUp(tmp_path_factory.mktemp("page") / "tried", kind="trials", title=NASTY)
    made.detector_speed()
    for backend, scale in (("msckf", 1.0), ("sliding_window", 9.0)):
        for seed in range(3):
            made.trial(backend, seed, scale)
    made.trial("msckf", 3, 1.0, "diverged")
    return write(made)


# What is in it --------------------------------------------------------------------------------------------------------


def test_page_fetches_nothing(page: Path) -> None:
    elements = Elements(page.read_text(encoding="utf-8"))
    assert not elements.all("src")
    assert [tag for tag, attributes in elements.found if tag == "link" and attributes["href"] != "data:,"] == []
    assert not re.search(r"url\(|@import", page.read_text(encoding="utf-8").split("</style>")[0])
    policy = next(value for value in elements.all("content") if "default-src" in value)
    assert policy.startswith("default-src 'none'")


def test_page_is_small_enough_to_send(stressed: Path) -> None:
    assert stressed.stat().st_size < 8e6


def test_every_link_leads_to_a_folder_also_after_a_move(compared: MadeUp, page: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(compared.path, tmp_path / "moved")
    elements = Elements(page.read_text(encoding="utf-8"))
    targets = [href for href in elements.all("href") if not href.startswith(("#", "data:"))]
    assert targets
    assert all((moved / "report" / unquote(target)).is_dir() for target in targets)
    runs = {
        str(path.relative_to(compared.path))
        for path in compared.path.glob("runs/*")
        if (path / "trajectory.tum").is_file()
    }
    linked = {unquote(target).removeprefix("../").rstrip("/") for target in targets}
    assert runs <= linked


def test_anchors_of_the_contents_are_there(page: Path) -> None:
    elements = Elements(page.read_text(encoding="utf-8"))
    anchors = {href[1:] for href in elements.all("href") if href.startswith("#")}
    assert anchors <= set(elements.all("id"))
    assert {"accuracy", "trajectories", "translation-error", "rotation-error", "relative-error", "timing"} < anchors
    assert {"failures", "evo", "machine"} < anchors


def test_sections_without_anything_to_show_are_left_out(tried: Path) -> None:
    sections = [a["id"] for tag, a in Elements(tried.read_text(encoding="utf-8")).found if tag == "section"]
    assert sections == ["speed", "consistency", "machine"]


def test_a_page_without_a_reference_shows_none_of_it(tmp_path: Path) -> None:
    made = comparison(tmp_path / "plain", reference=False)
    made.detector_speed()
    text = Elements(write(made).read_text(encoding="utf-8")).text
    assert "RMSE" in text
    found = re.findall(r"(?i)\bthesis\b|\bours\b|\bfigure 3|\b3\.9\b|20 cm|\bquoted\b", text)
    assert found == []
    with_reference = Elements(write(comparison(tmp_path / "named")).read_text(encoding="utf-8")).text
    assert {"thesis", "20 cm"} <= set(re.findall(r"thesis|20 cm", with_reference))


def test_page_has_every_table_with_its_caption(compared: MadeUp, page: Path) -> None:
    elements = Elements(page.read_text(encoding="utf-8"))
    ids = set(elements.all("id"))
    for table in tables(compared.study()):
        if table.name != "evo":
            assert f"table-{table.name}" in ids
            assert table.caption in elements.text


def test_page_prints_the_evo_command_of_every_flight_with_an_error(compared: MadeUp, page: Path) -> None:
    text = Elements(page.read_text(encoding="utf-8")).text
    evo = next(table for table in tables(compared.study()) if table.name == "evo")
    assert len(evo.rows) == 6
    for row in evo.rows:
        assert row.entries["command"].shown in text
        assert f"{row.entries['task'].shown}: ATE {row.entries['ATE, SE(3) [m]'].shown} m" in text


def test_failures_are_listed_with_their_line(page: Path) -> None:
    text = Elements(page.read_text(encoding="utf-8")).text
    assert "PluginError: it broke" in text
    assert "Without any pose" not in text  # Each contender has a seed that can be drawn.


def test_plots_say_what_the_data_was_and_whose_pose_is_missing(tmp_path: Path) -> None:
    made = MadeUp(tmp_path / "results", detectors=["orb", "fast"], backends=["msckf"])
    made.flight(labels(detector="orb"), data=Data.SIMULATED)
    made.failed(labels(detector="fast"), data=Data.SIMULATED)
    html = write(made).read_text(encoding="utf-8")
    plots = json.loads(re.search(r'<script type="application/json" id="plots">(.*?)</script>', html)[1])
    caption = plots["trajectories_3d"]["cases"][0]["caption"]
    said = "Data (simulated): MH_05_difficult: made up for a test. Without any pose to draw: fast with msckf."
    assert caption == said


def test_text_from_results_is_never_markup(tried: Path) -> None:
    html = tried.read_text(encoding="utf-8")
    assert NASTY not in html
    assert NASTY in Elements(html).text


def test_missing_libraries_are_one_line_with_the_remedy(
    compared: MadeUp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "vioframe.report.suite.page")
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(PluginError, match=r'plotly\S*: pip install "vioframe\[bench\]"$') as caught:
        write_report(compared.load(), tmp_path / "report")
    assert "\n" not in str(caught.value)


# The headline ---------------------------------------------------------------------------------------------------------


def test_headline_of_a_claim_is_how_far_it_holds(tmp_path: Path) -> None:
    made = MadeUp(tmp_path / "results", reference=True)
    made.flight(labels(detector="keypointnet", backend="sliding_window"), bias_m=(0.0, 0.9, 0.0))
    made.flight(labels(detector="shi_tomasi", backend="msckf"), sigma_m=0.01)
    study = made.study()
    subject = next(row for row in records(study.flights) if row["detector"] == "keypointnet")
    inside = study.errors(subject).inside_band(0.2)
    assert inside["y"] < 60.0  # The bias shows, so that the two figures cannot be mixed up.
    first, more = headline(study)
    assert first == (
        f"KeypointNet with sliding_window: y inside ±20 cm for {inside['y']:.0f} % of the estimated time, altitude for "
        f"{inside['z']:.0f} %."
    )
    assert "the lowest here is that of Shi-Tomasi with msckf" in more


def test_headline_of_one_flight_is_the_lowest_error(tmp_path: Path) -> None:
    made = MadeUp(tmp_path / "results")
    made.flight(labels(detector="keypointnet", backend="sliding_window"))
    made.flight(labels(detector="shi_tomasi", backend="msckf"), sigma_m=0.01)
    (said,) = said_by(made)
    assert re.fullmatch(
        r"shi_tomasi with msckf: its ATE is \S+ m?m, the lowest here; "
        r"next is keypointnet with sliding_window, \S+ m?m\.",
        said,
    )


def test_headline_counts_failures(compared: MadeUp) -> None:
    known = facts(compared.study())
    assert known["Flights complete"] == "6 of 8"
    assert known["Tasks failed"] == "1 of 8"


def test_headline_of_hard_conditions_is_who_succeeds(tmp_path: Path) -> None:
    first, more = said_by(stress(tmp_path / "results"))
    assert re.fullmatch(r"Flights that succeed under hard conditions: keypointnet \d+ %, shi_tomasi \d+ %\.", first)
    assert more.startswith("keypointnet with msckf against shi_tomasi, flight by flight: 8 won, 0 lost, 0 tied;")


def test_headline_compares_nobody_across_recordings(tmp_path: Path) -> None:
    made = MadeUp(tmp_path / "results", reference=True)
    made.flight(labels("a", detector="keypointnet", backend="sliding_window"), data=Data.REAL, sigma_m=0.2)
    made.flight(labels("a", detector="orb", backend="msckf"), data=Data.REAL, sigma_m=0.001, completion=0.2)
    made.flight(labels("b", detector="fast", backend="msckf"), data=Data.SIMULATED, sigma_m=0.001)
    first, more = said_by(made)
    assert first.startswith("KeypointNet with sliding_window on a (real): y inside")
    assert "fast" not in more
    assert "ORB" not in more


def test_headline_never_mixes_kinds_of_data(tmp_path: Path) -> None:
    made = MadeUp(tmp_path / "results")
    made.flight(labels("a", "fog", 1.0), data=Data.RENDERED, sigma_m=0.001)
    made.failed(labels("b", "fog", 1.0), data=Data.SIMULATED)
    assert said_by(made) == [
        "Flights that succeed under hard conditions (rendered): shi_tomasi 100 %.",
        "Flights that succeed under hard conditions (simulated): shi_tomasi 0 %.",
    ]


def test_headline_of_speed_and_trials(tried: Path) -> None:
    text = Elements(tried.read_text(encoding="utf-8")).text
    assert "fast runs at 700 frames a second on this machine." in text
    said = re.search(r"sliding_window on figure_eight: pose NEES (\S+) times the ideal over 3 trials, (\w+)", text)
    assert float(said[1]) == pytest.approx(9.0, rel=0.1)
    assert said[2] == "overconfident"


def test_headline_of_nothing_but_failures(tmp_path: Path) -> None:
    made = MadeUp(tmp_path / "results")
    made.failed(labels())
    text = Elements(write(made).read_text(encoding="utf-8")).text
    assert "Nothing in this suite has a figure yet." in text
    assert "PluginError: it broke" in text


# In a browser ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium of the system, which draws WebGL in software."""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs Chromium: apt-get install chromium chromium-driver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "use-angle=swiftshader"):
        options.add_argument(f"--{argument}")
    options.add_argument("--enable-unsafe-swiftshader")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = webdriver.Chrome(options, webdriver.ChromeService(driver))
    # Software that draws WebGL takes its time on a busy machine.
    opened.set_script_timeout(120)
    yield opened
    opened.quit()


def load(browser: Any, page: Path, *plots: str, width: int = 1200) -> list[str]:
    """Open ``page`` and draw ``plots`` besides those in sight; returns the addresses that were asked for."""
    screen = {"width": width, "height": 300, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    choose_colours(browser, "light")
    for log in ("performance", "browser"):
        browser.get_log(log)
    browser.get(page.as_uri())
    for plot in plots:
        browser.execute_script(f"document.querySelector('#plot-{plot}').dispatchEvent(new Event('show'))")
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]


def plots_of(page: Path) -> list[str]:
    return Elements(page.read_text(encoding="utf-8")).all("data-plot")


def choose_colours(browser: Any, scheme: str) -> None:
    """In ``scheme``; and without scrolling smoothly, under which a click may miss."""
    chosen = {"prefers-color-scheme": scheme, "prefers-reduced-motion": "reduce"}
    features = [{"name": name, "value": value} for name, value in chosen.items()]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def settle(browser: Any) -> None:
    """Wait until what was changed is on the screen."""
    browser.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")


def visible(browser: Any, plot: str) -> list[tuple[str, bool]]:
    """(series, shown or not) of the traces of a plot that have one."""
    canvases = f"[...document.querySelectorAll('#plot-{plot} .canvas')]"
    traces = browser.execute_script(f"return {canvases}.flatMap(c => c.data.map(t => [t.meta.series, t.visible]))")
    return [(series, shown) for series, shown in traces if series]


def column(browser: Any, table: str, k: int) -> list[str]:
    rows = f"[...document.querySelectorAll('#{table} tbody tr')]"
    return list(browser.execute_script(f"return {rows}.map(row => row.cells[{k}].textContent.trim())"))


def click(browser: Any, selector: str) -> None:
    element = browser.find_element("css selector", selector)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", element)
    element.click()


@pytest.mark.parametrize("name", ["page", "stressed", "tried"])
def test_page_loads_alone_and_without_errors(browser: Any, request: pytest.FixtureRequest, name: str) -> None:
    path = request.getfixturevalue(name)
    asked = load(browser, path, *plots_of(path))
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == [path.as_uri()]
    # Plotly reads back what is under the pointer, which Chromium has advice about.
    errors = [entry for entry in browser.get_log("browser") if "willReadFrequently" not in entry["message"]]
    assert errors == []
    empty = [plot for plot in plots_of(path) if not visible(browser, plot)]
    assert empty == []


def test_paths_are_drawn_in_3d_and_hidden_with_the_legend(browser: Any, page: Path) -> None:
    load(browser, page, "trajectories_3d", width=600)

    def coloured() -> int:
        """Pixels of the picture that are not grey: lines of estimates, not of the truth or the axes."""
        size = "{width: 400, height: 300}"
        url = browser.execute_async_script(
            f"Plotly.toImage(document.querySelector('#plot-trajectories_3d .canvas'), {size}).then(arguments[0])"
        )
        png = np.frombuffer(b64decode(url.partition(",")[2]), np.uint8)
        image = cv2.imdecode(png, cv2.IMREAD_COLOR).astype(int)
        return int((image.max(axis=2) - image.min(axis=2) > 80).sum())

    assert browser.find_elements("css selector", "#plot-trajectories_3d .gl-container canvas")
    assert coloured() > 500
    for series in dict(visible(browser, "trajectories_3d")):
        click(browser, f"#plot-trajectories_3d .legend button[data-series='{series}']")
    assert {shown for _, shown in visible(browser, "trajectories_3d")} == {False}
    assert coloured() == 0


def test_views_turn_the_camera(browser: Any, page: Path) -> None:
    load(browser, page, "trajectories_3d", width=600)
    for view, axis in (("top", "z"), ("side", "y")):
        click(browser, f"#plot-trajectories_3d [data-view={view}]")
        seen = browser.execute_script(
            "return document.querySelector('#plot-trajectories_3d .canvas').layout.scene.camera"
        )
        assert seen["projection"]["type"] == "orthographic"
        assert [key for key, value in seen["eye"].items() if value] == [axis]
        pressed = browser.find_element("css selector", "#plot-trajectories_3d .views [aria-pressed=true]")
        assert pressed.get_attribute("data-view") == view


def test_legend_hides_one_series_of_one_plot(browser: Any, page: Path) -> None:
    load(browser, page, "translation_error_per_axis", "rotation_error")
    before = visible(browser, "rotation_error")
    first = "#plot-translation_error_per_axis .legend button"
    click(browser, first)
    hidden = browser.find_element("css selector", first).get_attribute("data-series")
    assert {series for series, shown in visible(browser, "translation_error_per_axis") if not shown} == {hidden}
    assert {shown for series, shown in visible(browser, "translation_error_per_axis") if series != hidden} == {True}
    assert visible(browser, "rotation_error") == before
    assert browser.find_element("css selector", first).get_attribute("aria-pressed") == "false"


def test_filter_hides_a_detector_in_all_plots_and_tables(browser: Any, page: Path) -> None:
    load(browser, page, "translation_error_per_axis", "relative_error", "timing")
    box = ".filters input[value=keypointnet]"
    click(browser, box)
    for plot in ("translation_error_per_axis", "relative_error"):
        assert {series.split(" · ")[0] for series, shown in visible(browser, plot) if not shown} == {"keypointnet"}
        assert {series.split(" · ")[0] for series, shown in visible(browser, plot) if shown} == {"shi_tomasi"}
    bars = browser.execute_script(
        "return document.querySelector('#plot-timing .canvas').data.flatMap(trace => trace.y)"
    )
    assert {name.split(" · ")[0] for name in bars} == {"shi_tomasi"}
    every = "[...document.querySelectorAll('tr[data-detector]')]"
    rows = f"return {every}.map(row => [row.dataset.detector, row.checkVisibility()])"
    assert {tuple(row) for row in browser.execute_script(rows)} == {("keypointnet", False), ("shi_tomasi", True)}
    click(browser, box)
    assert all(shown for _, shown in visible(browser, "translation_error_per_axis"))
    assert all(shown for _, shown in browser.execute_script(rows))


@pytest.mark.parametrize("keyboard", [False, True])
def test_tables_are_sorted_by_their_headers(browser: Any, page: Path, keyboard: bool) -> None:
    load(browser, page)
    header = "#table-accuracy th.number"
    k = int(browser.find_element("css selector", header).get_property("cellIndex"))
    unsorted = column(browser, "table-accuracy", k)

    def sort() -> str:
        if keyboard:
            browser.find_element("css selector", f"{header} button").send_keys(ENTER)
        else:
            click(browser, f"{header} button")
        return str(browser.find_element("css selector", header).get_attribute("aria-sort"))

    assert sort() == "ascending"
    assert column(browser, "table-accuracy", k) == sorted(unsorted, key=float)
    assert sort() == "descending"
    assert column(browser, "table-accuracy", k) == sorted(unsorted, key=float, reverse=True)
    click(browser, "#table-accuracy th button")
    assert column(browser, "table-accuracy", 0) == sorted(column(browser, "table-accuracy", 0))
    assert browser.find_element("css selector", header).get_attribute("aria-sort") == "none"


def test_what_is_missing_is_sorted_last_either_way(browser: Any, tried: Path) -> None:
    load(browser, tried)
    for expected in (["80.0", "250.0", "700.0"], ["700.0", "250.0", "80.0"]):
        click(browser, "#table-detector_fps th:nth-of-type(2) button")
        found = column(browser, "table-detector_fps", 1)
        assert found[:3] == expected
        assert set(found[3:]) == {"–"}


def test_one_choice_of_flight_is_for_all_plots(browser: Any, stressed: Path) -> None:
    load(browser, stressed, "translation_error_per_axis", "stress")
    caption = "return document.querySelector('#plot-translation_error_per_axis .canvas').data[0].y.bdata"
    before = browser.execute_script(caption)
    click(browser, "#plot-trajectories_3d select option:nth-child(3)")
    chosen = [each.get_property("value") for each in browser.find_elements("css selector", "select.case")]
    assert set(chosen) == {"figure_eight, motion blur 1 (simulated)"}
    assert len(chosen) == 6
    assert browser.execute_script(caption) != before
    # A picture a condition.
    assert len(browser.find_elements("css selector", "#plot-stress .canvas")) == 2


def test_dark_pages_have_their_own_colours(browser: Any, page: Path) -> None:
    line = "return document.querySelector('#plot-translation_error_per_axis .canvas').data[0].line.color"
    background = "return getComputedStyle(document.body).backgroundColor"
    load(browser, page, "translation_error_per_axis")
    assert browser.execute_script(line) == "#0072b2"
    assert browser.execute_script(background) == "rgb(255, 255, 255)"
    choose_colours(browser, "dark")
    settle(browser)
    assert browser.execute_script(line) == "#4aa3e0"
    assert max(map(int, re.findall(r"\d+", browser.execute_script(background)))) < 40


@pytest.mark.parametrize("width", [360, 800, 1600])
def test_nothing_reaches_beyond_the_screen(browser: Any, page: Path, width: int) -> None:
    load(browser, page, "translation_error_per_axis", "relative_error", "timing", width=width)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
