"""Figures of a suite's report, and the report as a whole."""

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib import colors
from suite_helpers import MadeUp, comparison, labels, stress
from vioframe.report.suite.pooled import BAND_M, inside, pool_relative
from vioframe.report.suite.results import Data, SuiteResults
from vioframe.report.suite.stress import curves

from vioframe.cli import main
from vioframe.report.style import RC
from vioframe.report.suite import figures as module
from vioframe.report.suite import figures_cost, figures_flights, figures_spread, figures_stress
from vioframe.report.suite.figures import figures, write_figures
from vioframe.report.suite.report import write_report
from vioframe.report.suite.statistics import groups

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def _look() -> Iterator[None]:
    with mpl.rc_context(dict(RC)):
        yield


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> SuiteResults:
    return comparison(tmp_path_factory.mktemp("suite") / "results").load()


@pytest.fixture(scope="module")
def stressed(tmp_path_factory: pytest.TempPathFactory) -> SuiteResults:
    return stress(tmp_path_factory.mktemp("suite") / "results").load()


@pytest.fixture(scope="module")
def course(compared: SuiteResults) -> figures_flights.Course:
    found = figures_flights.Course.of(groups(compared))
    assert found is not None
    return found


def test_the_figures_of_the_thesis_have_its_numbers(compared):
    assert [name for name, _ in figures(compared)] == [
        "fig_3_09_trajectories_3d",
        "fig_3_10_translation_error_per_axis",
        "fig_3_11_rotation_error",
        "fig_3_12_comparison",
        "fig_3_13_top_view",
        "fig_3_14_side_view",
        "relative_error",
        "nees",
        "timing",
    ]


def test_several_recordings_have_names_of_their_own_and_an_overview(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels("MH_05_difficult"), data=Data.REAL)
    made.flight(labels("V1_01_easy"), data=Data.SIMULATED)
    made.failed(labels("V2_03_difficult"), data=Data.REAL)
    per_recording = ("translation_error_per_axis", "top_view", "relative_error")
    assert [name for name, _ in figures(made.load())] == [
        *(f"MH_05_difficult_real_{name}" for name in per_recording),
        *(f"V1_01_easy_simulated_{name}" for name in per_recording),
        "ate_by_sequence",
        "timing",
    ]


def test_each_is_written_as_png_and_as_svg_that_is_the_same_again(tmp_path):
    made = MadeUp(tmp_path / "r", kind="detector_speed")
    made.detector_speed()
    results = made.load()
    first = write_figures(results, tmp_path / "a")
    assert [path.name for path in first] == ["detector_fps.png", "detector_fps.svg"]
    assert first[0].read_bytes().startswith(PNG)
    assert write_figures(results, tmp_path / "b")[1].read_bytes() == first[1].read_bytes()
    assert "shi_tomasi" in first[1].read_text(encoding="utf-8")


def test_there_is_a_column_a_back_end_and_a_colour_a_detector(course):
    figure = figures_flights.rotation_error(course)
    axes = np.array(figure.axes).reshape(3, 2)
    assert [ax.get_title("left") for ax in axes[0]] == ["sliding_window", "msckf"]
    drawn = [{line.get_color() for line in ax.lines if len(line.get_xdata()) > 2} for ax in axes.flat]
    assert drawn == [{"#0072B2", "#D55E00"}] * 6


def test_the_band_is_shaded_and_the_legend_says_how_much_is_inside(course):
    figure = figures_flights.translation_error(course)
    axes = np.array(figure.axes).reshape(3, 2)
    for ax in axes.flat:
        assert ax.patches[0].get_bbox().intervaly.tolist() == [-BAND_M, BAND_M]
        low, high = ax.get_ylim()
        assert low < -BAND_M
        assert high > BAND_M
    share = inside(course.drawn[0].errors)
    assert axes[1, 0].get_legend().get_texts()[0].get_text() == f"{share['y']:.1f} % inside"
    assert "±20 cm" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_comparison_has_the_root_mean_squares_of_the_evaluation(course):
    axes = np.array(figures_flights.comparison(course).axes).reshape(2, 2)
    errors = course.drawn[0].errors
    assert axes[0, 0].get_legend().get_texts()[0].get_text() == f"RMSE {errors.ate_m.rmse:.3g} m"
    assert axes[1, 0].get_legend().get_texts()[0].get_text() == f"RMSE {errors.orientation_deg.rmse:.3g} deg"


def test_a_back_end_that_is_far_worse_has_a_scale_of_its_own(tmp_path):
    made = MadeUp(tmp_path / "r", backends=["msckf", "loose_ekf"])
    made.flight(labels(backend="msckf"), sigma_m=0.02)
    made.flight(labels(backend="loose_ekf"), sigma_m=0.02, bias_m=(3.0, 0.0, 0.0))
    course = figures_flights.Course.of(groups(made.load()))
    axes = np.array(figures_flights.translation_error(course).axes).reshape(3, 2)
    assert axes[0, 1].get_ylim()[1] > 4.0 * axes[0, 0].get_ylim()[1]
    assert axes[2, 1].get_ylim() == axes[2, 0].get_ylim()


def test_whoever_began_later_is_drawn_later(tmp_path):
    from trajectory_helpers import disturbed, flight

    made = MadeUp(tmp_path / "r")
    truth = flight(160, seed=3)
    made.flight(labels(detector="shi_tomasi"))
    made.flight(labels(detector="orb"), estimate=disturbed(truth, 0.02, 0.01).select(np.arange(160) >= 40))
    course = figures_flights.Course.of(groups(made.load()))
    begins = [line.get_xdata()[0] for line in figures_flights.comparison(course).axes[0].lines]
    late_s = (truth.t_ns[40] - truth.t_ns[0]) * 1e-9
    assert sorted(begins) == pytest.approx([0.0, late_s])


def test_no_line_is_drawn_across_a_gap(tmp_path):
    from trajectory_helpers import disturbed, flight

    made = MadeUp(tmp_path / "r")
    truth = flight(160, seed=3)
    keep = np.abs(np.arange(160) - 80) > 15
    made.flight(labels(), estimate=disturbed(truth, 0.02, 0.01).select(keep))
    course = figures_flights.Course.of(groups(made.load()))
    line = figures_flights.top_view(course).axes[0].lines[1]
    assert np.isnan(line.get_xdata()).sum() == 1


def test_figures_say_what_the_data_was_and_which_flight_is_shown(course):
    for draw in (figures_flights.trajectories_3d, figures_flights.side_view, figures_spread.nees_over_time):
        caption = " ".join(draw(course).get_supxlabel().split())
        assert caption.endswith(
            "Shown: the seed of the median ATE, of two the worse. Data (rendered): MH_05_difficult: made up for a test."
        )


def test_boxes_are_of_all_flights_of_a_contender(compared):
    figure = figures_spread.relative_error(pool_relative(groups(compared)))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "shi_tomasi, sliding_window",
        "shi_tomasi, msckf",
        "keypointnet, sliding_window",
        "keypointnet, msckf",
    ]
    assert "Pooled over the 1 to 2 flights" in " ".join(figure.get_supxlabel().split())


def test_stress_has_a_panel_a_condition_and_marks_where_flights_failed(stressed):
    found = groups(stressed)
    figure = figures_stress.error_curves(curves(found), found)
    assert [ax.get_title("left") for ax in figure.axes] == ["motion blur, msckf", "fog, msckf"]
    hollow = [
        [colors.to_hex(line.get_markerfacecolor()) for line in ax.lines if line.get_marker() == "o"].count("#ffffff")
        for ax in figure.axes
    ]
    assert hollow == [0, 1]
    assert all(len(ax.collections) == 2 for ax in figure.axes)  # a band a detector
    assert "20 flights; 1 without an error to show." in " ".join(figure.get_supxlabel().split())


def test_success_counts_failed_flights(stressed):
    found = groups(stressed)
    fog = figures_stress.success_curves(curves(found), found).axes[1]
    lines = [line.get_ydata() for line in fog.lines if len(line.get_xdata()) == 3]
    assert [values.tolist() if hasattr(values, "tolist") else list(values) for values in lines] == [
        [100, 100, 50],
        [100] * 3,
    ]


def test_stress_suites_have_no_figures_of_single_flights(stressed):
    assert [name for name, _ in figures(stressed)] == ["stress_error", "stress_success", "timing"]


def test_trials_are_drawn_as_a_monte_carlo(tmp_path):
    made = MadeUp(tmp_path / "r", kind="trials", backends=["msckf"], seeds=3)
    for seed in range(3):
        made.trial("msckf", seed, 1.0)
    found = dict(figures(made.load()))
    assert list(found) == ["nees_figure_eight", "trials"]
    for figure in found.values():
        assert " ".join(figure.get_supxlabel().split()).endswith("Data (simulated): tracks and IMU, no images.")


def test_detectors_that_were_not_measured_are_named(tmp_path):
    made = MadeUp(tmp_path / "r", kind="detector_speed")
    made.detector_speed()
    quoted, measured = figures_cost.detector_speed(made.load().tasks[0]).axes
    names = [label.get_text() for label in quoted.get_yticklabels()]
    assert names[:3] == ["fast", "shi_tomasi", "orb"]
    assert len(names) == 3 + 8  # the other detectors of Table 3.2
    said = [text.get_text() for text in measured.texts]
    assert said.count("not measured here") == 8
    assert "not quoted" in [text.get_text() for text in quoted.texts]


def test_where_everything_failed_there_is_nothing_to_draw(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.failed(labels())
    assert list(figures(made.load())) == []


@pytest.fixture
def quick(monkeypatch):
    """One small figure, for tests that only care that figures are there."""
    monkeypatch.setattr(module, "_DPI", 20)
    monkeypatch.setattr(module, "FORMATS", ("png",))
    monkeypatch.setattr(module, "figures", lambda results: islice(figures(results), 1))


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
    stale = first.folder / "stale.txt"
    stale.touch()
    write_report(results, page=False)
    assert not stale.exists()
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["report", "suite.yaml", "tasks"]


@pytest.mark.usefixtures("quick")
def test_a_report_elsewhere_links_to_the_results(tmp_path):
    write_report(small(tmp_path / "a" / "results").load(), tmp_path / "b" / "c", page=False)
    text = (tmp_path / "b" / "c" / "tables" / "accuracy.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\((.*?)\)", text)
    assert len(links) == 2
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
    assert f"{report / 'tables'}: 7 csv" in said.output
    assert f"{report / 'figures'}: 1 png" in said.output
    assert "note: the sweep is unfinished: 2 of 3 tasks" in said.output
    assert not (report / "index.html").exists()


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda path: None, "holds no suite.yaml"),
        (lambda path: MadeUp(path), "holds no result yet"),
        (lambda path: _with_damaged_task(path), "holds no readable task.json"),
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
    assert f"cannot write the report to {out}: " in said.output


def _with_damaged_task(path: Path) -> None:
    small(path)
    next(path.rglob("task.json")).write_text("{")
