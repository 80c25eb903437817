import json
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from trajectory_helpers import disturbed, flight, write_run

from vioframe.cli import main
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import write_tum
from vioframe.report.drawing import drawings, write_figures
from vioframe.report.figures import figures_of_runs, stage_bars
from vioframe.report.style import RC, colour
from vioframe.runs.evaluated import Evaluated, evaluate_paths

PATHS = {"trajectories_3d", "top_view", "side_view"}
ERRORS = {"translation_error_per_axis", "rotation_error", "comparison", "relative_error"}
EVERYTHING = PATHS | ERRORS | {"timing", "tracks"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Run folders ``a`` and ``b`` of one flight, and ``b`` as a bare file."""
    folder = tmp_path_factory.mktemp("runs")
    truth = flight()
    for name, sigma_m in (("a", 0.02), ("b", 0.1)):
        write_run(folder / name, disturbed(truth, sigma_m, 0.01), truth)
    write_tum(disturbed(truth, 0.1, 0.01), folder / "b.tum")
    return folder


@pytest.fixture(scope="module")
def runs(folder):
    return evaluate_paths([folder / "a", folder / "b"])


def drawn(runs, name, half_width_m=0.0):
    with mpl.rc_context(dict(RC)):
        return next(canvas for file, canvas in drawings(figures_of_runs(runs, half_width_m), {}) if file == name)


def names(runs):
    return {name for name, _ in drawings(figures_of_runs(runs), {})}


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_everything_is_drawn_of_runs_that_have_everything(folder, tmp_path):
    result = CliRunner().invoke(main, ["plot", str(folder / "a"), str(folder / "b"), "--out", str(tmp_path), "--svg"])
    assert result.exit_code == 0, result.output
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {f"{name}.{ending}" for name in EVERYTHING for ending in ("png", "svg")}
    assert {line.rsplit("/", 1)[-1] for line in result.stdout.splitlines()} == written
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in tmp_path.glob("*.png"))


def test_one_run_gets_its_plots_in_its_folder(folder):
    assert CliRunner().invoke(main, ["plot", str(folder / "a")]).exit_code == 0
    assert {path.stem for path in (folder / "a" / "plots").iterdir()} == EVERYTHING


def test_equal_runs_give_equal_figures(runs, tmp_path):
    for name in ("one", "two"):
        write_figures(figures_of_runs(runs), tmp_path / name, formats=("svg", "png"))
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


def test_a_bare_file_is_drawn_as_far_as_it_goes(folder):
    assert names(evaluate_paths([folder / "b.tum"], folder / "a" / "ground_truth.tum")) == PATHS | ERRORS
    assert names(evaluate_paths([folder / "b.tum"])) == PATHS


def test_a_run_without_a_pose_does_not_spoil_the_others(tmp_path, folder):
    write_run(tmp_path / "never", flight(30), flight(30), waiting=30)
    assert names(evaluate_paths([tmp_path / "never", folder / "a"])) == EVERYTHING


@pytest.mark.parametrize(("view", "axes"), [("top_view", (0, 1)), ("side_view", (0, 2))])
def test_a_metre_is_a_metre_on_both_axes_and_nothing_is_cut_off(runs, view, axes):
    ax = drawn(runs, view).axes[0]
    assert ax.get_aspect() == 1.0
    p_WB = runs[0].ground_truth.p_WB
    for k, (low, high) in zip(axes, (ax.get_xlim(), ax.get_ylim()), strict=True):
        assert low < p_WB[:, k].min()
        assert p_WB[:, k].max() < high
    assert "[m]" in ax.get_xlabel()
    assert "[m]" in ax.get_ylabel()


def test_the_3d_axes_are_to_scale(runs):
    ax = drawn(runs, "trajectories_3d").axes[0]
    sizes = np.array([np.ptp(limits) for limits in (ax.get_xlim(), ax.get_ylim(), ax.get_zlim())])
    np.testing.assert_allclose(ax._box_aspect / ax._box_aspect[0], sizes / sizes[0], rtol=1e-6)


def test_every_run_is_named_and_the_alignment_stated(runs):
    for name in ("trajectories_3d", "top_view", "side_view", "translation_error_per_axis", "rotation_error"):
        figure = drawn(runs, name)
        truth = [] if "error" in name else ["ground truth"]
        assert legend(figure) == [*truth, "a", "b"]
        assert "position + yaw" in figure.get_supxlabel()


def test_the_curves_are_the_errors(runs):
    expected = evaluate(runs[1].estimate, runs[1].ground_truth)
    for name, series in [
        ("translation_error_per_axis", expected.position_m),
        ("rotation_error", expected.rotation_rpy_deg),
    ]:
        figure = drawn(runs, name)
        for k, ax in enumerate(figure.axes):
            (line,) = [line for line in ax.get_lines() if line.get_color() == colour(1)]
            np.testing.assert_array_equal(line.get_ydata(), series[:, k].astype(np.float32))
            # The first ten frames had no estimate; time counts from where the ground truth begins.
            assert line.get_xdata()[0] == pytest.approx(0.5)


def test_the_band_is_as_wide_as_asked(runs):
    with_band = drawn(runs, "translation_error_per_axis", half_width_m=0.2)
    assert "±20 cm" in with_band.get_supxlabel()
    for ax in with_band.axes:
        (band,) = ax.patches
        assert (band.get_y(), band.get_height()) == (-0.2, 0.4)
    assert all(not ax.patches for ax in drawn(runs, "translation_error_per_axis").axes)


def test_no_line_is_drawn_across_a_gap():
    truth = flight()
    run = evaluate_run(truth.select(np.r_[0:100, 200:400]), truth)
    (line,) = drawn([run], "translation_error_per_axis").axes[0].get_lines()
    assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [100]


def test_a_run_that_is_lost_does_not_flatten_the_others(runs):
    truth = flight()
    away_m = 1e3 * np.linspace(0.0, 1.0, len(truth))[:, None] ** 3
    lost = replace(evaluate_run(Trajectory(truth.t_ns, truth.R_WB, truth.p_WB + away_m), truth), name="lost")
    for name in ("translation_error_per_axis", "relative_error", "comparison", "top_view"):
        alone, beside = (drawn(each, name) for each in (runs, [*runs, lost]))
        assert "lost leaves the picture" in " ".join(beside.get_supxlabel().split())
        for ax, before in zip(beside.axes, alone.axes, strict=True):
            assert np.ptp(ax.get_ylim()) == pytest.approx(np.ptp(before.get_ylim()), rel=0.3)


def test_errors_of_millimetres_are_drawn_in_millimetres():
    truth = flight()
    run = evaluate_run(disturbed(truth, 1e-3, 1e-3), truth)
    ax = drawn([run], "translation_error_per_axis").axes[0]
    assert ax.get_ylabel() == "x [mm]"
    expected = (1e3 * run.errors.position_m[:, 0]).astype(np.float32)
    np.testing.assert_array_equal(ax.get_lines()[0].get_ydata(), expected)


@pytest.mark.parametrize(("overconfident", "inside"), [(1.0, "100 % inside"), (30.0, "10 % inside")])
def test_errors_are_drawn_within_what_is_said_of_them(overconfident, inside):
    truth = flight()
    shift_m = np.linspace(0.0, 0.03, len(truth))[:, None] * [1.0, 0.0, 0.0]
    sigma = np.array([*[1e-3] * 3, *[0.01 / overconfident] * 3])
    cov = np.tile(np.diag(sigma**2), (len(truth), 1, 1))
    estimate = Trajectory(truth.t_ns, truth.R_WB, truth.p_WB + shift_m, cov)
    canvas = drawn([evaluate_run(estimate, truth)], "translation_error_bounds")
    ax = canvas.axes[0]
    (band,) = ax.patches
    assert np.abs(band.get_xy()[:, 1]).max() == pytest.approx(30.0 / overconfident)
    share = float(ax.get_legend().get_texts()[0].get_text().split()[0])
    assert share == pytest.approx(float(inside.split()[0]), abs=8.0)
    assert "rotation_error_bounds" in {figure.name for figure in figures_of_runs([evaluate_run(estimate, truth)])}


def evaluate_run(estimate, truth):
    return Evaluated("holed", None, estimate, truth, evaluate(estimate, truth))


def test_a_loop_closed_path_has_its_runs_colour_and_other_dashes(tmp_path, folder):
    for loops in (0, 1):
        path = tmp_path / f"{loops}"
        truth = flight()
        write_run(path, disturbed(truth, 0.02, 0.01), truth)
        write_tum(disturbed(truth, 0.01, 0.01), path / "trajectory_loop.tum")
        summary = json.loads((path / "summary.json").read_text())
        (path / "summary.json").write_text(json.dumps({**summary, "loop_closure": {"loops": loops}}))
    # Where no loop was accepted it would be drawn on top of its run.
    runs = evaluate_paths([tmp_path / "0", tmp_path / "1", folder / "a"])
    assert [run.name for run in runs] == ["0", "1", "1 with loop closure", "a"]
    lines = drawn(runs, "rotation_error").axes[0].get_lines()
    assert [line.get_color() for line in lines] == [colour(0), colour(1), colour(1), colour(2)]
    assert [line.get_linestyle() for line in lines] == ["-", "-", "--", "-"]


def test_a_short_path_shows_fractions_of_itself():
    truth = flight()
    short = Trajectory(truth.t_ns, truth.R_WB, truth.p_WB / 20.0)
    lower = drawn([evaluate_run(disturbed(short, 0.001, 0.001), short)], "relative_error").axes[1]
    assert lower.get_xlabel() == "length of the stretch [% of the path]"
    assert [tick.get_text() for tick in lower.get_xticklabels()] == ["10", "20", "30", "40", "50"]


def test_the_bars_add_up_to_the_time_a_frame(runs):
    ax = drawn(runs, "timing").axes[0]
    ends = [bar.get_x() + bar.get_width() for bar in ax.patches]
    assert max(ends) == pytest.approx(sum(runs[0].stage_ms().values()), rel=1e-9)
    assert f"{max(ends):.1f} ms" in {text.get_text() for text in ax.texts}


@pytest.mark.parametrize("figure", ["comparison", "timing"])
@pytest.mark.filterwarnings("error::UserWarning")
def test_many_runs_leave_room_for_their_lines(runs, figure):
    """What is noted of each goes into several rows: in one it would push the panels out."""
    many = [replace(runs[k % 2], name=f"run {k}") for k in range(8)]
    canvas = drawn(many, figure)
    canvas.draw_without_rendering()
    assert all(ax.get_position().width > 0.6 for ax in canvas.axes)


def test_stages_stand_as_a_frame_goes_through_them():
    stages = ["loop_closure", "backend.update", "klt", "backend.other", "detect"]
    traces, _ = stage_bars(pd.DataFrame([[1.0] * 5], ["run"], stages), [])
    assert [trace["meta"]["series"] for trace in traces] == [
        *("klt", "detect", "update", "rest of back-end", "loop closure")
    ]
    assert len({trace["marker"]["color"] for trace in traces}) == 5


def test_a_run_without_times_has_no_bar(runs):
    truth = flight()
    ax = drawn([evaluate_run(truth, truth), *runs], "timing").axes[0]
    assert [label.get_text() for label in ax.get_yticklabels()] == [run.name for run in runs]


def test_figures_that_cannot_be_written_are_one_line(folder, tmp_path):
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(main, ["plot", str(folder / "a"), "--out", str(tmp_path / "file")])
    assert result.exit_code == 2
    assert "cannot write figures" in result.stderr
    assert len(result.stderr.splitlines()) == 1
