"""Figures of a suite's report: described once, shown by the page and drawn into files; and the report as a whole."""

import re
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import plotly.graph_objects as go
import pytest
from click.testing import CliRunner
from suite_helpers import MadeUp, comparison, labels, stress
from trajectory_helpers import disturbed, flight

from vioframe.cli import main
from vioframe.report import drawing
from vioframe.report.drawing import drawings, write_figures
from vioframe.report.figures import Figure
from vioframe.report.style import RC
from vioframe.report.suite.figures import figures
from vioframe.report.suite.report import write_report
from vioframe.report.suite.statistics import Study, records
from vioframe.report.units import length
from vioframe.runs.results import Data

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def _look() -> Iterator[None]:
    with mpl.rc_context(dict(RC)):
        yield


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return comparison(tmp_path_factory.mktemp("suite") / "results").study()


@pytest.fixture(scope="module")
def stressed(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return stress(tmp_path_factory.mktemp("suite") / "results").study()


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """Three detectors with two back-ends each."""
    made = MadeUp(tmp_path_factory.mktemp("crowded") / "r")
    for detector, backend in product(("orb", "shi_tomasi", "sift"), ("msckf", "sliding_window")):
        made.flight(labels(detector=detector, backend=backend))
    return made.study()


def named(study: Study) -> dict[str, Figure]:
    return {figure.name: figure for figure in figures(study)}


def traces_of(study: Study, name: str) -> list[dict[str, Any]]:
    return [trace for case in named(study)[name].cases.values() for traces, _ in case.pictures for trace in traces]


def files_of(study: Study) -> list[str]:
    names = {name: quoted.file for name, quoted in study.results.reference.figures.items()}
    return [name for name, _ in drawings(figures(study), names)]


def drawn(study: Study, name: str) -> Any:
    return next(canvas for file, canvas in drawings([named(study)[name]], {}) if file == name)


def test_figures_have_the_numbers_of_the_reference(compared):
    assert sorted(files_of(compared)) == [
        *("fig_3_09_trajectories_3d", "fig_3_10_translation_error_per_axis", "fig_3_11_rotation_error"),
        *("fig_3_12_comparison", "fig_3_13_top_view", "fig_3_14_side_view", "nees", "relative_error", "timing"),
    ]
    assert named(compared)["rotation_error"].title == "Figure 3.11: Rotation error"


def test_several_recordings_have_names_of_their_own_and_an_overview(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels("MH_05_difficult"), data=Data.REAL)
    made.flight(labels("V1_01_easy"), data=Data.SIMULATED)
    made.failed(labels("V2_03_difficult"), data=Data.REAL)
    per_recording = ("relative_error", "side_view", "top_view", "trajectories_3d", "translation_error_per_axis")
    assert sorted(files_of(made.study())) == [
        *(f"MH_05_difficult_real_{name}" for name in per_recording),
        *(f"V1_01_easy_simulated_{name}" for name in per_recording),
        *("ate_by_sequence", "real_timing", "simulated_timing"),
    ]


@pytest.mark.parametrize("which", ["compared", "stressed"])
def test_every_picture_is_one_that_plotly_knows(which, request):
    for figure in figures(request.getfixturevalue(which)):
        for case in figure.cases.values():
            for traces, layout in case.pictures:
                assert len(go.Figure(list(traces), layout).data) == len(traces) > 0


def test_each_is_written_as_png_and_as_svg_that_is_the_same_again(tmp_path):
    made = MadeUp(tmp_path / "r", kind="detector_speed")
    made.detector_speed()
    every = figures(made.study())
    first = write_figures(every, tmp_path / "a", formats=("png", "svg"))
    assert [path.name for path in first] == ["detector_fps.png", "detector_fps.svg"]
    assert first[0].read_bytes().startswith(PNG)
    assert write_figures(every, tmp_path / "b", formats=("svg",))[0].read_bytes() == first[1].read_bytes()
    assert "shi_tomasi" in first[1].read_text(encoding="utf-8")


def test_files_have_a_column_a_back_end_and_a_colour_a_detector(compared):
    axes = np.array(drawn(compared, "rotation_error").axes).reshape(3, 2)
    assert [ax.get_title("left") for ax in axes[0]] == ["sliding_window", "msckf"]
    colours = [{line.get_color() for line in ax.lines if len(line.get_xdata()) > 2} for ax in axes.flat]
    assert colours == [{"#0072b2", "#d55e00"}] * 6


def test_the_band_is_shaded_and_each_line_says_how_much_of_it_is_inside(compared):
    canvas = drawn(compared, "translation_error_per_axis")
    axes = np.array(canvas.axes).reshape(3, 2)
    for ax in axes.flat:
        assert ax.patches[0].get_bbox().intervaly.tolist() == [-0.2, 0.2]
        low, high = ax.get_ylim()
        assert low < -0.2 < 0.2 < high
    worst = compared.flights[compared.flights["evaluated"]].groupby("seed").get_group(1).iloc[0]
    share = compared.errors(worst).inside_band(0.2)
    assert axes[1, 0].get_legend().get_texts()[0].get_text() == f"{share['y']:.1f} % inside"
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == ["shi_tomasi", "keypointnet"]
    assert "±20 cm" in canvas.get_supxlabel()


@pytest.mark.parametrize("name", ["trajectories_3d", "relative_error"])
def test_a_legend_of_many_tells_detectors_by_colour_and_back_ends_by_dashes_or_shade(crowded, name):
    legend = drawn(crowded, name).legends[0]
    shown = dict(zip((text.get_text() for text in legend.get_texts()), legend.legend_handles, strict=True))
    shown.pop("ground truth", None)
    assert list(shown) == ["orb", "shi_tomasi", "sift", "msckf", "sliding_window"]
    lines = name == "trajectories_3d"
    looks = [(h.get_color(), h.get_linestyle()) if lines else h.get_facecolor() for h in shown.values()]
    assert len(set(looks)) == len(looks)


def test_notes_in_two_lines_leave_room_for_the_title(crowded):
    canvas = drawn(crowded, "comparison")
    canvas.draw_without_rendering()
    ax = canvas.axes[0]
    assert len(ax.get_legend().get_texts()) == 3
    assert ax._left_title.get_window_extent().y0 >= ax.get_legend().get_window_extent().y1


def test_without_a_reference_no_band_is_shaded(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels())
    figure = named(made.study())["translation_error_per_axis"]
    assert "shapes" not in next(iter(figure.cases.values())).pictures[0][1]
    assert "cm" not in figure.caption


def test_the_comparison_has_the_root_mean_squares_of_the_evaluation(compared):
    said = {
        (t["meta"]["detector"], t["meta"]["backend"], t["yaxis"]): t["meta"]["note"]
        for t in traces_of(compared, "comparison")
    }
    for row in records(compared.flights[compared.flights["evaluated"]].groupby(["detector", "backend"]).tail(1)):
        key = row["detector"], row["backend"]
        assert said[*key, "y"] == f"RMSE {length(row['ate_m'])}"
        assert said[*key, "y2"] == f"RMSE {row['orientation_deg']:.3g} deg"


def test_a_back_end_that_is_far_worse_has_a_scale_of_its_own(tmp_path):
    made = MadeUp(tmp_path / "r", detectors=["shi_tomasi", "orb"], backends=["msckf", "loose_ekf"])
    for detector in ("shi_tomasi", "orb"):
        made.flight(labels(detector=detector, backend="msckf"), sigma_m=0.02)
        made.flight(labels(detector=detector, backend="loose_ekf"), sigma_m=0.02, bias_m=(3.0, 0.0, 0.0))
    axes = np.array(drawn(made.study(), "translation_error_per_axis").axes).reshape(3, 2)
    assert axes[0, 1].get_ylim()[1] > 4.0 * axes[0, 0].get_ylim()[1]
    assert axes[2, 1].get_ylim() == axes[2, 0].get_ylim()


def test_whoever_began_later_is_drawn_later(tmp_path):
    made = MadeUp(tmp_path / "r")
    truth = flight(160, seed=3)
    made.flight(labels(detector="shi_tomasi"))
    made.flight(labels(detector="orb"), estimate=disturbed(truth, 0.02, 0.01).select(np.arange(160) >= 40))
    begins = [trace["x"][0] for trace in traces_of(made.study(), "rotation_error") if trace["x"] is not None]
    # The first five frames had no estimate; time counts from where the ground truth begins.
    assert sorted(begins) == pytest.approx([(truth.t_ns[k] - truth.t_ns[0]) * 1e-9 for k in (5, 45)])


def test_no_line_is_drawn_across_a_gap(tmp_path):
    made = MadeUp(tmp_path / "r")
    keep = np.abs(np.arange(160) - 80) > 15
    made.flight(labels(), estimate=disturbed(flight(160, seed=3), 0.02, 0.01).select(keep))
    study = made.study()
    gaps = {
        t["meta"]["series"]: np.isnan(t["x"]).sum() for t in traces_of(study, "trajectories_3d") if t["mode"] == "lines"
    }
    assert gaps == {"ground truth": 0, "msckf": 1}
    top = dict(drawings([named(study)["trajectories_3d"]], {}))["top_view"]
    assert [np.isnan(line.get_xdata()).sum() for line in top.axes[0].lines] == [0, 1, 0]


def test_figures_say_what_the_data_was_and_which_flight_is_shown(compared):
    for name in ("trajectories_3d", "rotation_error", "nees"):
        assert " ".join(drawn(compared, name).get_supxlabel().split()).endswith(
            "Data (rendered): MH_05_difficult: made up for a test. Of 2 seeds the one with the larger error is drawn."
        )


def test_boxes_are_of_all_flights_of_a_contender(compared):
    boxes = [trace for trace in traces_of(compared, "relative_error") if trace["yaxis"] == "y"]
    assert [trace["meta"]["series"] for trace in boxes] == [
        f"{detector} · {backend}"
        for detector in ("shi_tomasi", "keypointnet")
        for backend in ("sliding_window", "msckf")
    ]
    errors = [compared.errors(row) for row in records(compared.flights[:2])]
    at_8m = np.concatenate([each.relative[8.0].translation_percent for each in errors])
    assert boxes[0]["median"][0] == pytest.approx(np.median(at_8m))


def test_stress_has_a_picture_a_condition_and_marks_where_flights_failed(stressed):
    assert files_of(stressed) == ["stress", "timing"]
    (case,) = named(stressed)["stress"].cases.values()
    assert [layout["title"]["text"] for _, layout in case.pictures] == ["motion blur", "fog"]
    curves = [t for traces, _ in case.pictures for t in traces if t["mode"] == "lines+markers" and t["yaxis"] == "y"]
    assert [t["marker"]["symbol"].count("circle-open") for t in curves] == [0, 0, 1, 0]
    single = [t for traces, _ in case.pictures for t in traces if t["mode"] == "markers"]
    assert [len(t["y"]) for t in single] == [6, 6, 5, 6]
    success = [t["y"] for t in case.pictures[1][0] if t["mode"] == "lines+markers" and t["yaxis"] == "y2"]
    assert success == [[100, 100, 50], [100] * 3]


def test_trials_are_drawn_with_the_bounds_of_an_honest_filter(tmp_path):
    made = MadeUp(tmp_path / "r", kind="trials", backends=["msckf"], seeds=3)
    for seed in range(3):
        made.trial("msckf", seed, 1.0)
    study = made.study()
    assert files_of(study) == ["nees_of_trials", "trials"]
    assert [t["meta"]["series"] for t in traces_of(study, "nees_of_trials")] == [
        "95 % if honest",
        "single trials",
        "msckf",
    ] * 3
    assert "figure_eight: made up for a test." in drawn(study, "trials").get_supxlabel()


def test_what_is_quoted_stands_beside_what_was_measured_only_where_there_is_a_reference(tmp_path):
    for reference in (True, False):
        made = MadeUp(tmp_path / f"{reference}", kind="detector_speed", reference=reference)
        made.detector_speed()
        found = {trace["meta"]["series"]: trace for trace in traces_of(made.study(), "detector_fps")}
        assert found["measured here"]["y"] == ["fast", "shi_tomasi", "orb"]
        assert ("quoted" in found) == reference


def test_where_everything_failed_there_is_nothing_to_draw(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.failed(labels())
    assert figures(made.study()) == []


@pytest.fixture
def quick(monkeypatch):
    """One small figure, for tests that only care that figures are there."""
    monkeypatch.setattr(drawing, "_DPI", 20)
    monkeypatch.setattr(drawing, "drawings", lambda *given: islice(drawings(*given), 1))


def small(path: Path) -> MadeUp:
    made = MadeUp(path, detectors=["shi_tomasi"], backends=["msckf"], sequences=["MH_05_difficult"], seeds=3)
    made.flight(labels(seed=0))
    made.failed(labels(seed=1))
    return made


@pytest.mark.usefixtures("quick")
def test_a_report_replaces_the_one_before_and_tells_of_an_unfinished_sweep(tmp_path):
    results = small(tmp_path / "results").load()
    (tmp_path / "results" / ".report.unfinished").mkdir()
    first = write_report(results, page=False)
    assert first.folder == tmp_path / "results" / "report"
    assert first.notes == (
        "the sweep is unfinished: 2 of 3 tasks; `vioframe bench` goes on where it was stopped",
        "1 of 2 tasks failed; tables/failures.md has their errors",
    )
    assert all((first.folder / file).is_file() for file in first.files)
    stale, theirs = first.folder / "figures" / "stale.png", first.folder / "notes.txt"
    for file in (stale, theirs):
        file.touch()
    write_report(results, page=False)
    assert not stale.exists()
    assert theirs.exists()
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == [
        "report",
        "results.jsonl",
        "runs",
        "suite.yaml",
    ]


@pytest.mark.usefixtures("quick")
def test_a_report_elsewhere_links_to_the_results(tmp_path):
    write_report(small(tmp_path / "a" / "results").load(), tmp_path / "b" / "c", page=False)
    text = (tmp_path / "b" / "c" / "tables" / "accuracy.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\((.*?)\)", text)
    assert len(links) == 1
    assert all((tmp_path / "b" / "c" / "tables" / link).is_dir() for link in links)


def test_another_folder_is_never_replaced(tmp_path):
    small(tmp_path / "results")
    precious = tmp_path / "other" / "thesis.tex"
    precious.parent.mkdir()
    precious.touch()
    said = CliRunner().invoke(main, ["report", str(tmp_path / "results"), "--out", str(precious.parent), "--no-page"])
    assert said.exit_code == 2
    assert said.output.count("\n") == 1
    assert "is no report, so it stays; choose another --out" in said.output
    assert precious.exists()


@pytest.mark.usefixtures("quick")
def test_the_command_says_what_it_wrote_and_what_to_know(tmp_path):
    small(tmp_path / "results")
    said = CliRunner().invoke(main, ["report", str(tmp_path / "results"), "--no-page"])
    assert said.exit_code == 0, said.output
    report = tmp_path / "results" / "report"
    assert f"{report / 'tables'}: 6 csv" in said.output
    assert f"{report / 'figures'}: 1 png" in said.output
    assert f"{report / 'figures'}: 1 svg" in said.output
    assert "note: the sweep is unfinished: 2 of 3 tasks" in said.output
    assert not (report / "index.html").exists()


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda path: None, "holds no suite.yaml"),
        (lambda path: MadeUp(path), "holds no result yet"),
        (lambda path: _with_a_damaged_table(path), "results.jsonl is damaged"),
    ],
)
def test_what_is_no_results_folder_is_one_line(tmp_path, make, problem):
    make(tmp_path / "results")
    said = CliRunner().invoke(main, ["report", str(tmp_path / "results")])
    assert said.exit_code == 2
    assert said.output.count("\n") == 1
    assert problem in said.output


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    small(tmp_path / "results")
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "report"
    said = CliRunner().invoke(main, ["report", str(tmp_path / "results"), "--out", str(out), "--no-page"])
    assert said.exit_code == 2
    assert said.output.count("\n") == 1
    assert f"cannot write {out}: " in said.output


def _with_a_damaged_table(path: Path) -> None:
    small(path)
    (path / "results.jsonl").write_text("{")
