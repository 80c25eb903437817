"""Tables of a suite's report: what is in them, and as CSV, Markdown and LaTeX."""

import csv
import re
from io import StringIO

import numpy as np
import pytest
from suite_helpers import MACHINE, MadeUp, comparison, labels, stress

from vioframe.evaluation import evaluate
from vioframe.report.suite.statistics import Study, groups, records
from vioframe.report.suite.tables import tables, write_tables
from vioframe.report.table import Table, TableRow, number, text
from vioframe.runs.folder import RunFolder

AWKWARD = Table(
    "awkward",
    "A_b & c",
    "50 % of #1 | ~x^2 {y} \\ <z>, ±1 $",
    (
        TableRow(
            {"name": text("a|b_c"), "value [m_s]": number(1 / 3, ".2f"), "none": text(""), "run it": text("go --x_y")},
            (("run", "runs/k"),),
        ),
        TableRow({"name": text(""), "value [m_s]": number(None, ".2f"), "run it": text("")}),
    ),
    code="run it",
)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return comparison(tmp_path_factory.mktemp("suite") / "results").study()


def column(table: Table, heading: str) -> list[object]:
    return [row.entries[heading].value if heading in row.entries else None for row in table.rows]


def named(study: Study) -> dict[str, Table]:
    return {table.name: table for table in tables(study)}


def test_csv_has_exact_values_and_the_folders():
    rows = list(csv.reader(StringIO(AWKWARD.to_csv())))
    assert rows == [
        ["name", "value [m_s]", "run it", "runs"],
        ["a|b_c", repr(1 / 3), "go --x_y", "runs/k"],
        ["", "", "", ""],
    ]


def test_markdown_is_escaped_and_links_lead_from_where_it_is_to_the_results():
    assert AWKWARD.to_markdown("../..").splitlines() == [
        "**A\\_b & c**",
        "",
        "| name | value [m\\_s] | run it | runs |",
        "| --- | ---: | --- | --- |",
        "| a\\|b\\_c | 0.33 | `go --x_y` | [run](../../runs/k) |",
        "| – | – | – |  |",
        "",
        "50 % of #1 \\| ~x^2 {y} \\\\ \\<z>, ±1 $",
    ]


def test_latex_is_a_booktabs_table_with_everything_escaped():
    tex = AWKWARD.to_latex()
    assert (
        "A\\_b \\& c. 50 \\% of \\#1 \\textbar{} \\textasciitilde{}x\\textasciicircum{}2 \\{y\\} \\textbackslash{}"
        in tex
    )
    assert "\\textless{}z\\textgreater{}, $\\pm$1 \\$" in tex
    assert "a\\textbar{}b\\_c & 0.33 & \\texttt{go --x\\_y} \\\\" in tex
    assert [line.strip() for line in tex.splitlines() if "rule" in line] == ["\\toprule", "\\midrule", "\\bottomrule"]
    assert "\\begin{tabular}{lrl}" in tex


def test_every_table_is_written_three_times_and_its_links_lead_somewhere(compared, tmp_path):
    folder = compared.results.path / "report" / "tables"
    written = write_tables(tables(compared), folder, "../..")
    names = ("duels", "accuracy", "band", "timing", "nees_flights", "failures", "evo", "provenance")
    assert [path.name for path in written] == [f"{name}.{ending}" for name in names for ending in ("csv", "md", "tex")]
    links = {
        link for path in folder.glob("*.md") for link in re.findall(r"\]\((.*?)\)", path.read_text(encoding="utf-8"))
    }
    assert len(links) == 7  # one failed before it left any folder
    assert all((folder / link).is_dir() for link in links)


def test_beside_every_ate_stands_what_is_needed_to_read_it(compared):
    table = named(compared)["accuracy"]
    assert column(table, "seeds") == ["2", "1 of 2; 1 failed", "2", "1 of 2; 1 never initialised"]
    own = next(own for _, own in groups(compared.flights))
    ate = own["ate_m"]
    for heading, value in (
        ("ATE, position + yaw [m]", ate.mean()),
        ("std [m]", ate.std()),
        ("median [m]", ate.median()),
        ("min [m]", ate.min()),
        ("max [m]", ate.max()),
        ("ATE, SE(3) [m]", own["ate_se3_m"].mean()),
        ("start offset [s]", "5 to 5.5"),
        ("initialised after [s]", 0.25),
        ("completion [%]", 100.0),
        ("resets, all seeds", 0.0),
    ):
        assert column(table, heading)[0] == value, heading
    assert column(table, "std [m]")[1] is None
    assert "loop closure" not in table.headings
    assert table.rows[0].links == tuple(
        (f"seed {k}", f"runs/MH_05_difficult.clear_0.shi_tomasi.sliding_window.seed{k}") for k in range(2)
    )
    assert table.caption.endswith(
        "8 flights; 2 without an error to show. Data (rendered): MH_05_difficult: made up for a test."
    )


@pytest.mark.parametrize("name", ["accuracy", "band", "nees_flights"])
def test_captions_say_what_the_data_was(compared, name):
    assert "Data (rendered): MH_05_difficult" in named(compared)[name].caption


def test_published_rows_keep_their_alignment_and_stand_apart(tmp_path):
    published = [
        {
            "system": "VINS-Mono",
            "alignment": "sim3",
            "source": "a paper",
            "ate_m": {"MH_05_difficult": 0.35, "V1_01_easy": 0.07},
        },
        {"system": "OpenVINS", "alignment": "se3", "source": "a benchmark", "ate_m": {"V1_01_easy": 0.06}},
    ]
    made = MadeUp(tmp_path / "r", published=published)
    made.flight(labels(seed=0))
    made.failed(labels(seed=1))
    study = made.study()
    table = named(study)["published"]
    assert table.headings[3:] == ["MH_05_difficult (rendered) [m]", "V1_01_easy [m]"]
    assert column(table, "system") == ["VINS-Mono", "OpenVINS", *["shi_tomasi + msckf"] * 3]
    assert column(table, "alignment") == ["Sim(3)", "SE(3)", "position + yaw", "SE(3)", "Sim(3)"]
    assert column(table, "source")[0] == "published: a paper"
    flown = study.flights.iloc[0]
    run = RunFolder.open(study.results.path / flown["folder"])
    by_sim3 = evaluate(run.trajectory(), run.ground_truth(), alignment="sim3").ate_m.rmse
    measured = [flown["ate_m"], flown["ate_se3_m"], pytest.approx(by_sim3, rel=1e-9)]
    assert column(table, "MH_05_difficult (rendered) [m]") == [0.35, None, *measured]
    assert by_sim3 < flown["ate_se3_m"]
    assert table.rows[2].entries["MH_05_difficult (rendered) [m]"].shown.endswith("(1 of 2)")
    assert column(table, "V1_01_easy [m]") == [0.07, 0.06, None, None, None]


def test_where_every_seed_failed_the_published_table_says_so(tmp_path):
    made = MadeUp(tmp_path / "r", published=[{"system": "x", "alignment": "se3", "source": "y", "ate_m": {}}])
    made.failed(labels())
    assert (
        named(made.study())["published"].rows[1].entries["MH_05_difficult (rendered) [m]"].shown == "0 of 1; 1 failed"
    )


def test_the_band_is_that_of_the_reference_with_the_worst_of_the_seeds(tmp_path):
    made = MadeUp(tmp_path / "r", reference=True)
    for seed in range(2):
        made.flight(labels(seed=seed), sigma_m=0.1 + 0.1 * seed)
    study = made.study()
    table = named(study)["band"]
    errors = [study.errors(row) for row in records(study.flights)]
    y, z = (100.0 * np.mean([np.abs(each.position_m[:, k]) <= 0.2 for each in errors], axis=1) for k in (1, 2))
    assert column(table, "|y| within 20 cm [% of time]") == [pytest.approx(y.mean())]
    assert column(table, "y, worst seed [% of time]") == [pytest.approx(y.min())]
    assert column(table, "z, worst seed [% of time]") == [pytest.approx(z.min())]
    assert y.min() < y.max()
    assert study.results.reference.band.claim in table.caption


def test_metrics_have_a_column_a_figure_and_a_mean_over_the_seeds(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0), **{"metrics.ate.ate_m": 1.0, "metrics.ate.scale": 2.0})
    made.flight(labels(seed=1), **{"metrics.ate.ate_m": 3.0})
    table = named(made.study())["metrics"]
    assert column(table, "ate.ate_m") == [2.0]
    assert column(table, "ate.scale") == [2.0]


def test_a_metric_that_cannot_tell_says_why(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(), metrics_left_out={"nees": "there is no covariance"})
    assert "No nees (1 of the flights): there is no covariance." in named(made.study())["metrics"].caption


def test_a_mean_is_shown_with_its_spread(compared):
    first, lone, *_ = named(compared)["accuracy"].rows
    values = next(own for _, own in groups(compared.flights))["orientation_deg"]
    assert first.entries["orientation [deg]"].shown == f"{values.mean():.2f} ± {values.std():.2f}"
    assert "±" not in lone.entries["orientation [deg]"].shown


def test_an_average_leads_to_the_runs_behind_it(tmp_path):
    made = MadeUp(tmp_path / "r", sequences=["a", "b", "c"])
    for sequence in "ab":
        made.flight(labels(sequence))
    made.failed(labels("c"))
    (row,) = named(made.study())["averages"].rows
    assert row.links == tuple((f"{s}, seed 0", f"runs/{s}.clear_0.shi_tomasi.msckf.seed0") for s in "ab")


def test_what_could_not_be_evaluated_is_told_with_the_reason(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(), ate_m=None, not_evaluated="2 poses are too few to align")
    table = named(made.study())["failures"]
    assert column(table, "outcome") == ["not evaluated"]
    assert column(table, "reason") == ["2 poses are too few to align"]


def test_what_never_flew_has_no_band_and_without_a_reference_nothing_has(tmp_path):
    made = MadeUp(tmp_path / "r", reference=True)
    made.failed(labels())
    assert "band" not in named(made.study())
    plain = MadeUp(tmp_path / "plain")
    plain.flight(labels())
    assert "band" not in named(plain.study())


def test_stress_tables_count_the_failed(tmp_path):
    found = named(stress(tmp_path / "r").study())
    table = found["stress"]
    values = table.values
    worst = values[(values["condition"] == "fog") & (values["level"] == 1.0) & (values["detector"] == "shi_tomasi")]
    assert worst[["flights", "success [%]"]].to_numpy().tolist() == [["1 of 2; 1 failed", 50.0]]
    duels = found["duels"]
    assert column(duels, "won") == [2, 4, 4, 8]
    assert column(duels, "p, Holm") == [0.5, 0.375, 0.375, 2**-7]  # three conditions together, and all of them alone
    assert column(duels, "condition")[-1] == "all degraded"
    assert duels.title == "Against shi_tomasi"
    assert "better than shi_tomasi." in duels.caption


def test_detectors_quoted_and_measured_stand_apart_and_the_absent_say_why(tmp_path):
    made = MadeUp(tmp_path / "r", kind="detector_speed", reference=True)
    made.detector_speed()
    table = named(made.study())["detector_fps"]
    shown = table.values.set_index("detector")[["quoted [FPS]", "measured here [FPS]", "quartiles [FPS]"]].T
    assert list(shown["shi_tomasi"]) == [160.0, 250.0, "225.0 to 275.0"]
    assert list(shown["fast"])[1:] == [700.0, "630.0 to 770.0"]
    assert list(shown["superpoint"])[::2] == [67.0, "not measured: needs the option 'weights'"]
    assert list(shown["lf_net"])[::2] == [25.0, "not measured: no such detector is installed"]
    assert column(table, "quoted [FPS]")[0] is None
    assert "a processor, 2 cores" in table.caption
    assert "hardware not stated" in table.values.set_index("detector")["quoted from"]["keypointnet"]


def test_without_a_reference_nothing_is_quoted(tmp_path):
    made = MadeUp(tmp_path / "r", kind="detector_speed")
    made.detector_speed()
    table = named(made.study())["detector_fps"]
    assert table.title == "Detector speed"
    assert table.headings[:2] == ["detector", "measured here [FPS]"]
    assert column(table, "detector") == ["fast", "shi_tomasi", "orb", "superpoint"]


def test_timing_leaves_out_flights_that_never_initialised(compared):
    table = named(compared)["timing"]
    assert column(table, "flights") == [2, 1, 2, 1]
    stages = table.values[[heading for heading in table.headings if heading.endswith(" [ms]")]]
    whole = list(table.values["all [ms a frame]"])
    assert list(stages.sum(axis="columns")) == pytest.approx(whole, abs=1e-3)
    assert "Measured on a processor (2 cores). Data (rendered)" in table.caption


def test_trials_are_judged_by_their_nees_and_failures_counted(tmp_path):
    made = MadeUp(tmp_path / "r", kind="trials", backends=["msckf", "loose_ekf"], seeds=6)
    for seed in range(6):
        made.trial("msckf", seed, 1.0)
        made.trial("loose_ekf", seed, 9.0, "diverged" if seed == 0 else None)
    table = named(made.study())["nees"]
    assert column(table, "back-end") == ["msckf", "loose_ekf"]
    assert table.rows[0].links == tuple(
        (f"seed {k}", f"runs/figure_eight.clear_0.simulated_tracks.msckf.seed{k}") for k in range(6)
    )
    assert dict(zip(column(table, "back-end"), column(table, "pose, verdict"), strict=True)) == {
        "msckf": "consistent",
        "loose_ekf": "overconfident",
    }
    assert dict(zip(column(table, "back-end"), column(table, "failed"), strict=True)) == {
        "msckf": "none",
        "loose_ekf": "1 diverged",
    }
    assert dict(zip(column(table, "back-end"), column(table, "pose NEES, ideally 6"), strict=True))[
        "msckf"
    ] == pytest.approx(6.0, rel=0.1)


def test_failures_are_listed_with_their_reasons(compared):
    table = named(compared)["failures"]
    assert dict(zip(column(table, "outcome"), column(table, "reason"), strict=True)) == {
        "failed": "PluginError: it broke",
        "never initialised": "never initialised; last: initialisation refused: not at rest",
    }


def test_a_suite_without_trouble_has_no_table_of_it(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels())
    assert "failures" not in named(made.study())


def test_evo_has_a_command_for_each_evaluated_flight(compared):
    table = named(compared)["evo"]
    assert len(table.rows) == 6
    for command in table.values["command"]:
        assert all((compared.results.path / file).is_file() for file in command.split()[2:4])


def test_provenance_tells_machines_apart(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0))
    made.flight(labels(seed=1), machine={**MACHINE, "cpu": "another processor"})
    rows = [tuple(row) for row in named(made.study())["provenance"].values.to_numpy()]
    assert ("commit", "abc", 2) in rows
    assert ("numpy", "2.0", 2) in rows
    assert ("digest of the code", "1", 2) in rows
    assert {row for row in rows if row[0] == "cpu"} == {("cpu", "a processor", 1), ("cpu", "another processor", 1)}
