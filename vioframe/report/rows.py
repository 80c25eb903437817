"""What an evaluation says, as labelled rows of text; :mod:`vioframe.report.tables` lays them out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from vioframe.evaluation import RelativeErrors, Stats, TrajectoryErrors
from vioframe.evaluation.map_quality import WITHIN_M, MapQuality
from vioframe.runs.evaluated import Evaluated

ALIGNED_BY = {"posyaw": "position + yaw", "se3": "SE(3)", "sim3": "Sim(3)", "first": "first pose"}

_UNKNOWN = "–"
Rows = list[tuple[str, list[str]]]
Section = tuple[str, Rows]


def sections(runs: Sequence[Evaluated]) -> list[Section]:
    """(title, rows) by topic; a row is a label and one cell a run. Rows that no run has are left out."""
    groups = [
        ("Run", _run_rows(runs)),
        *_error_sections(runs),
        ("Landmarks, distance from the simulated world's surfaces [m]", _map_rows(runs)),
        *_metric_sections(runs),
        ("Time, ms a frame", _timing_rows(runs)),
    ]
    known = [(title, [row for row in rows if any(cell != _UNKNOWN for cell in row[1])]) for title, rows in groups]
    return [(title, rows) for title, rows in known if rows]


def notes(runs: Sequence[Evaluated]) -> Iterator[str]:
    """One line for each thing a reader of the figures should know."""
    for run in runs:
        if run.folder and not run.summary.get("finished", False):
            yield f"{run.name}: the run was interrupted; these figures cover what it left"
        if run.folder and run.segment_starts_ns:
            segments = len(run.segment_starts_ns) + 1
            yield f"{run.name}: {segments} segments between resets, measured as one trajectory"
        if run.estimate is None:
            yield f"{run.name}: never initialised, so there is no pose to evaluate"
        elif run.errors is None:
            yield f"{run.name}: no ground truth; pass --ground-truth to measure errors"
        else:
            yield from (f"{run.name}: {note}" for note in run.errors.notes)
        if run.measured is not None:
            yield from (f"{run.name}: metric {label}: {why}" for label, why in run.measured.left_out.items())


def _run_rows(runs: Sequence[Evaluated]) -> Rows:
    def errors(format_: Callable[[TrajectoryErrors], str]) -> list[str]:
        return _cells(runs, format_)

    def summary(key: str, spec: str, factor: float | None = None) -> list[str]:
        found = [run.summary.get(key) for run in runs]
        return [_UNKNOWN if x is None else format(x if factor is None else factor * x, spec) for x in found]

    return [
        ("detector", summary("detector", "")),
        ("back-end", summary("backend", "")),
        ("start offset [s]", summary("start_s", ".1f")),
        ("initialised after [s]", summary("initialised_after_s", ".2f")),
        ("completion after that [%]", summary("completion", ".1f", 100.0)),
        ("resets", summary("resets", "d")),
        ("evaluated poses", errors(lambda e: str(len(e.estimate)))),
        ("ground truth covered [%]", errors(lambda e: f"{100.0 * e.coverage:.1f}")),
        ("path length [m]", errors(lambda e: f"{e.truth.path_length_m:.2f}")),
    ]


def _error_sections(runs: Sequence[Evaluated]) -> list[Section]:
    def cells(format_: Callable[[TrajectoryErrors], str]) -> list[str]:
        return _cells(runs, format_)

    how = next((ALIGNED_BY[run.errors.alignment_name] for run in runs if run.errors), "")
    position = [
        ("RMSE", cells(lambda e: f"{e.ate_m.rmse:.4f}")),
        ("mean", cells(lambda e: f"{e.ate_m.mean:.4f}")),
        ("median", cells(lambda e: f"{e.ate_m.median:.4f}")),
        ("max", cells(lambda e: f"{e.ate_m.max:.4f}")),
        ("max |x|, |y|, |z|", cells(lambda e: ", ".join(f"{x:.3f}" for x in e.max_position_m))),
        ("RMSE after SE(3) alignment", cells(lambda e: _or_unknown(e.ate_se3_m, ".4f"))),
        ("scale by Sim(3) [1]", cells(lambda e: _or_unknown(e.scale, ".4f"))),
    ]
    orientation = [
        ("RMSE", cells(lambda e: f"{e.orientation_deg.rmse:.3f}")),
        ("yaw RMSE", cells(lambda e: f"{e.yaw_deg.rmse:.3f}")),
        ("max |roll|, |pitch|, |yaw|", cells(lambda e: ", ".join(f"{x:.2f}" for x in e.max_rotation_deg))),
    ]
    return [
        (f"Position error, {how} aligned [m]", position),
        (f"Orientation error, {how} aligned [deg]", orientation),
        ("Relative error, mean: translation [%] / yaw [deg] / rotation [deg]", _relative_rows(runs)),
        ("NEES, mean (inside the 95 % band)", _nees_rows(runs)),
    ]


def _relative_rows(runs: Sequence[Evaluated]) -> Rows:
    """Over fixed lengths where a path is long enough for any, over fractions of the path where none is."""
    by_length = [run.errors.relative if run.errors else {} for run in runs]
    by_fraction = [run.errors.relative_by_fraction if run.errors else {} for run in runs]
    if lengths := sorted(set().union(*by_length)):
        return [(f"{d:g} m", [_relative_cell(each.get(d)) for each in by_length]) for d in lengths]
    parts = sorted(set().union(*by_fraction))
    return [(f"{100 * f:g} % of the path", [_relative_cell(each.get(f)) for each in by_fraction]) for f in parts]


def _relative_cell(errors: RelativeErrors | None) -> str:
    if errors is None:
        return _UNKNOWN
    means = (Stats.of(x).mean for x in (errors.translation_percent, errors.yaw_deg, errors.rotation_deg))
    return " / ".join(f"{mean:.2f}" for mean in means)


def _nees_rows(runs: Sequence[Evaluated]) -> Rows:
    def cell(errors: TrajectoryErrors, part: str) -> str:
        found = [f"{n.mean:.2f} ({100.0 * n.inside:.0f} %)" for n in errors.nees if n.part == part]
        return found[0] if found else _UNKNOWN

    parts = {"orientation": 3, "position": 3, "pose": 6}
    return [
        (f"{part}, ideally {dof}", [cell(run.errors, part) if run.errors else _UNKNOWN for run in runs])
        for part, dof in parts.items()
    ]


def _map_rows(runs: Sequence[Evaluated]) -> Rows:
    def cells(format_: Callable[[MapQuality], str]) -> list[str]:
        return [_UNKNOWN if run.map_quality is None else format_(run.map_quality) for run in runs]

    return [
        ("landmarks", cells(lambda m: str(m.landmarks))),
        ("median", cells(lambda m: f"{m.median_m:.4f}")),
        ("90 % are within", cells(lambda m: f"{m.q90_m:.4f}")),
        ("RMSE", cells(lambda m: f"{m.rmse_m:.4f}")),
        (
            "within " + ", ".join(f"{100 * limit:g}" for limit in WITHIN_M) + " cm [%]",
            cells(lambda m: ", ".join(f"{100 * part:.1f}" for _, part in m.within)),
        ),
    ]


def _metric_sections(runs: Sequence[Evaluated]) -> list[Section]:
    figures = [run.measured.figures if run.measured else {} for run in runs]
    out = []
    for label in dict.fromkeys(label for each in figures for label in each):
        found = [each.get(label, {}) for each in figures]
        names = dict.fromkeys(name for each in found for name in each)
        out.append((f"Metric {label}", [(n, [_or_unknown(each.get(n), ".4g") for each in found]) for n in names]))
    return out


def _timing_rows(runs: Sequence[Evaluated]) -> Rows:
    spent = [run.stage_ms() for run in runs]
    stages = dict.fromkeys(stage for each in spent for stage in each)
    rows = [(stage, [_or_unknown(each.get(stage), ".2f") for each in spent]) for stage in stages]
    return [("all", [_or_unknown(sum(each.values()) if each else None, ".2f") for each in spent]), *rows]


def _cells(runs: Sequence[Evaluated], format_: Callable[[TrajectoryErrors], str]) -> list[str]:
    return [_UNKNOWN if run.errors is None else format_(run.errors) for run in runs]


def _or_unknown(value: float | None, spec: str) -> str:
    return _UNKNOWN if value is None else format(value, spec)
