"""The sections of the page, in the order in which a reader asks; those with nothing to show are left out."""

from __future__ import annotations

from collections.abc import Iterable

from vioframe.report.suite import page_comparison, page_flights, page_speed, page_tables
from vioframe.report.suite.page_blocks import Block, Filter, Section
from vioframe.report.suite.page_look import Look
from vioframe.report.suite.results import Kind, SuiteResults
from vioframe.report.suite.statistics import flights, groups
from vioframe.report.suite.stress import curves, is_stress
from vioframe.report.suite.tables import tables
from vioframe.report.suite.tables_cost import pooled_stages
from vioframe.report.suite.trials import outcomes


def sections(results: SuiteResults, look: Look, to_results: str) -> list[Section]:
    """All of the report's tables are in one of them, and each plot that there is data for.

    ``to_results`` leads from the page's folder to that of the results.
    """
    found, table = groups(results), page_tables.blocks(tables(results), results, to_results)
    timed = [task for task in results.of(Kind.DETECTOR_SPEED) if task.ok]
    drawn = page_flights.courses(found)
    made = [
        _section(
            "speed",
            "Detector speed",
            "Quoted figures beside those measured here, on this machine. They are not like for like.",
            [*map(page_speed.frames_a_second, timed), table.pop("detector_fps", None)],
        ),
        _section(
            "stress",
            "Hard conditions",
            "How much worse each contender gets as a condition gets harder, and when it gives up.",
            [
                page_comparison.stress_curves(curves(found), look) if is_stress(found) else None,
                table.pop("duels", None),
                table.pop("stress", None),
            ],
        ),
        _section(
            "accuracy",
            "Accuracy",
            "Every figure is a mean over the seeds; the last column leads to the runs behind it.",
            [table.pop(name, None) for name in ("averages", "accuracy", "published", "metrics")],
        ),
        _section(
            "trajectories",
            "Trajectories",
            "",
            [page_flights.paths(drawn, look) if drawn else None],
        ),
        _section(
            "translation-error",
            "Translation error",
            "The thesis claims that y and the altitude stay within ±20 cm.",
            [page_flights.translation_errors(drawn, look) if drawn else None, table.pop("band", None)],
        ),
        _section(
            "rotation-error",
            "Rotation error",
            "",
            [page_flights.rotation_errors(drawn, look) if drawn else None],
        ),
        _section(
            "relative-error",
            "Drift by length",
            "Errors over stretches of the way do not depend on where the estimate was aligned.",
            [page_comparison.relative_errors(drawn, look)],
        ),
        _section(
            "timing",
            "Time a frame",
            "A real-time factor above 1 is faster than the camera.",
            [page_speed.stages(means, look) if (means := pooled_stages(found)) else None, table.pop("timing", None)],
        ),
        _section(
            "consistency",
            "Consistency",
            "Whether the covariance is as large as the errors are.",
            [
                page_speed.nees(outcomes(results), look, _trial_notes(results)),
                table.pop("nees", None),
                table.pop("nees_flights", None),
            ],
        ),
        _section("failures", "What went wrong", "", [table.pop("failures", None)]),
    ]
    about, evo = table.pop("provenance"), table.pop("evo", None)
    made.append(_section("more", "More tables", "", list(table.values())))
    if evo is not None:
        lead = f"Each ATE after SE(3) alignment, re-derived by another's code. {evo.table.caption}"
        made.append(_section("evo", "Check it with evo", lead, [page_tables.commands(flights(results))]))
    made.append(_section("machine", "Machine and versions", "", [about]))
    return [section for section in made if section.blocks]


def look_of(results: SuiteResults) -> Look:
    """Contenders in the order of the suite."""
    flown = [group.cell.contender for group in groups(results)]
    tracks = {task.labels.detector for task in results.of(Kind.TRIAL) if task.labels}
    tried = [(detector, outcome.backend) for detector in sorted(tracks) for outcome in outcomes(results)]
    detectors, backends = zip(*(flown or tried), strict=True) if flown or tried else ((), ())
    return Look(tuple(dict.fromkeys(detectors)), tuple(dict.fromkeys(backends)))


def filters(results: SuiteResults, look: Look) -> list[Filter]:
    """Of what there are several of."""
    by_colour = len(look.detectors) > 1
    detectors = {name: look.colour(name, "") if by_colour else "" for name in look.detectors}
    if not detectors:
        detectors = {
            row["detector"]: "" for task in results.of(Kind.DETECTOR_SPEED) if task.ok for row in task.result["rows"]
        }
    backends = {name: "" if by_colour else look.colour("", name) for name in look.backends}
    both = [Filter("detector", "Detectors", detectors), Filter("backend", "Back-ends", backends)]
    return [each for each in both if len(each.values) > 1]


def _section(id_: str, title: str, lead: str, blocks: Iterable[Block | None]) -> Section:
    return Section(id_, title, [block for block in blocks if block is not None], lead)


def _trial_notes(results: SuiteResults) -> dict[str, str]:
    return {task.labels.sequence: task.data_note.rstrip(".") + "." for task in results.of(Kind.TRIAL) if task.labels}
