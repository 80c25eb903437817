"""Writes the figures that README.md, benchmarks/README.md and docs/ show, from what is recorded in results/.

    python benchmarks/make_tables.py

A page says where, between two comments: ``<!-- figures: NAME -->`` and ``<!-- end -->``; NAME is a function here.
A test holds pages and records equal, so that no figure is typed by hand, and none outlives its record.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import pandas as pd

from vioframe.bench.detectors.degradations import Degradation
from vioframe.bench.detectors.tables import BASELINE, by_degradation
from vioframe.report.units import length

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
_DOCS = ROOT / "docs"
BLOCK = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
_MAY = (ROOT / "README.md", HERE / "README.md", *sorted(_DOCS.rglob("*.md")))
PAGES = tuple(path for path in _MAY if BLOCK.search(path.read_text(encoding="utf-8")))
_RENDERED = "MH_05_difficult"
_NEES = "NEES an axis of orientation, position (ideal 1)"


def headline() -> str:
    """What the built-in back-ends reach with the detector that is the default."""
    moving, landmarks, rendered = (
        recorded(name) for name in ("euroc_clips_*.json", "real_motion_*.json", "rendered_flights_*.json")
    )
    moving, rendered = (rows[rows["detector"] == "shi_tomasi"] for rows in (moving, rendered))
    rendered = rendered[rendered["options"] == ""]
    cases = {
        "first 15 s of MH_01_easy, real images": _in_m(moving[moving["clip"] == "MH_01_easy_15s"]),
        f"{_RENDERED} from 5 s, images rendered along it, real IMU": _in_m(rendered[rendered["clip"] == _RENDERED]),
        "MH_02, MH_03, MH_05, V1_01, V1_02, landmarks simulated along them, real IMU": landmarks,
    }
    rows = [
        {
            "recording": name,
            **{f"`{key}`": _ate(own) for key, own in _by_backend(found)},
            "path": _mean(found, "path_m"),
        }
        for name, found in cases.items()
    ]
    return markdown(rows) + source(moving, rendered, landmarks)


def real_images() -> str:
    """The clip in motion, every back-end and detector."""
    rows = recorded("euroc_clips_*.json")
    rows = rows[rows["clip"] == "MH_01_easy_15s"].sort_values(["backend", "ate_mm"])
    shown = [
        {
            "back-end": f"`{row.backend}`",
            "detector": f"`{row.detector}`",
            "initialised after": f"{row.initialised_s:.2f} s",
            "completion": f"{100.0 * row.completion:.1f} %",
            "resets": f"{row.resets}",
            "ATE": length(1e-3 * row.ate_mm),
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def stages() -> str:
    """Milliseconds a frame by stage, of the default detector in the clip in motion."""
    rows = recorded("euroc_clips_*.json")
    rows = rows[(rows["clip"] == "MH_01_easy_15s") & (rows["detector"] == "shi_tomasi")]
    names = {name: name.removeprefix("stage_ms.") for name in rows.columns if name.startswith("stage_ms.")}
    table = rows.set_index("backend")[list(names)].rename(columns=names)
    table.insert(0, "all", rows.set_index("backend")["frame_ms"])
    shown = [
        {"ms a frame": str(stage), **{f"`{backend}`": _number(value, ".1f") for backend, value in values.items()}}
        for stage, values in table.T.iterrows()
    ]
    return markdown(shown) + source(rows)


def planted_faults() -> str:
    """What is found first where a fault is planted, and that nothing is called wrong where there is none."""
    rows = recorded("planted_faults.json")
    bad, good = rows[rows["fault"] != "none"], rows[rows["fault"] == "none"]
    shown = [
        {"planted": row.fault, "into": row.recording, "found first": f"`{row.kind}`", "right": row.right}
        for row in _each(bad)
    ]
    told = (
        f"\nThe right cause is named first in {(bad['right'] == 'yes').sum()} of {len(bad)}; in "
        f"{(good['right'] == 'yes').sum()} of {len(good)} recordings without a fault nothing is called wrong "
        f"({', '.join(good['recording'])}).\n"
    )
    return markdown(shown) + told + source(rows)


def at_rest() -> str:
    """How far the estimate strays from where it began, of a body at rest."""
    rows = recorded("euroc_clips_*.json")
    rows = rows[rows["clip"] == "V1_01_easy_rest"]
    shown = [
        {
            "back-end": f"`{backend}`",
            "detectors": f"{len(own)}",
            "initialised after": _range(own["initialised_s"], ".2f", "s"),
            "farthest from where it began": _range(own["drift_mm"], ".1f", "mm"),
        }
        for backend, own in _by_backend(rows)
    ]
    return markdown(shown) + source(rows)


def landmarks() -> str:
    """Simulated landmarks along real motion: mean and deviation over the seeds."""
    rows = recorded("real_motion_*.json")
    shown = [
        {
            "flight": str(sequence),
            "path": _mean(own, "path_m"),
            **{
                f"`{backend}`": f"{_ate(found)}, {found['percent'].mean():.2f} %" for backend, found in _by_backend(own)
            },
            "resets": f"{own['resets'].sum()}",
        }
        for sequence, own in rows.groupby("sequence")
    ]
    return markdown(shown) + source(rows)


def rendered() -> str:
    """Whole flights with rendered images: over their worlds."""
    rows = recorded("rendered_flights_*.json")
    shown = [
        {
            "flight": str(clip),
            "back-end": f"`{backend}`",
            "detector": f"`{detector}`",
            "path": _mean(own, "path_m"),
            "initialised after": _range(own["initialised_s"], ".2f", "s"),
            "completion": f"{100.0 * own['completion'].min():.1f} %",
            "resets": f"{own['resets'].sum()}",
            "ATE": _ate(_in_m(own)),
            _NEES: _parts(own, "nees", ".2f", axes=3),
            "within the 95 % ellipsoid": _parts(own, "held_95", ".0%"),
        }
        for (clip, backend, detector), own in rows[rows["options"] == ""].groupby(["clip", "backend", "detector"])
    ]
    return markdown(shown) + source(rows)


def one_or_two() -> str:
    """Rendered flights by one camera and by both."""
    rows = _in_m(recorded("stereo_*.json"))
    shown = []
    for (clip, backend), own in rows.groupby(["clip", "backend"]):
        found = {str(cameras): flown for cameras, flown in own.groupby("cameras")}
        one, both = (found[cameras].set_index("world") for cameras in ("one", "both"))
        exact_one, exact_both = (found[f"{cameras}, exact points"]["ate_m"] for cameras in ("one", "both"))

        def beside(cameras: str, found: dict[str, pd.DataFrame] = found, both: pd.Series = both["ate_m"]) -> str:
            ate = found[cameras].set_index("world")["ate_m"]
            return f"{_spread(ate)}, {ate.mean() / both[ate.index].mean():.2f}"

        shown.append(
            {
                "flight": str(clip),
                "back-end": f"`{backend}`",
                "one camera": _ate(one),
                "both": _ate(both),
                "of one's ATE": f"{both['ate_m'].mean() / one['ate_m'].mean():.2f}",
                "exact points, both": f"{_spread(exact_both)}, {exact_both.mean() / exact_one.mean():.2f}",
                "both begin after": _range(both["initialised_s"], ".2f", "s"),
                "each black for 5 s": beside("both, black in turn"),
                "right one 20 ms later": beside("both, apart"),
                "resets": f"{own['resets'].sum()}",
                "of one's time, median": f"{(both['frame_ms'] / one['frame_ms']).median():.2f}",
            }
        )
    return markdown(shown) + source(rows)


def error_budget() -> str:
    """What each cause has of the error, by the flights on which it was taken away."""
    rows = _in_m(recorded("error_budget_*.json"))
    shown = []
    for backend, own in _by_backend(rows):
        flown = own[own["case"] == "as flown"].set_index(["sequence", "world"])["ate_m"]
        for case, of in own.groupby("case", sort=False):
            ate = of.set_index(["sequence", "world"])["ate_m"]
            ratios = (ate / flown).dropna()
            shown.append(
                {
                    "back-end": f"`{backend}`",
                    "case": str(case),
                    **{name: _ate(each) for name, each in of.groupby("sequence")},
                    "of as flown": f"{geometric_mean(ratios):.2f} (n = {len(ratios)})",
                    _NEES: _parts(of, "nees", ".2f", axes=3),
                }
            )
    return markdown(shown) + source(rows)


def take_off() -> str:
    """After rest: the demo's world, and others."""
    rows = recorded("take_off.json")
    shown = []
    for backend, own in _by_backend(rows):
        demo, others = own[own["world"] == 0], own[own["world"] != 0]
        shown.append(
            {
                "back-end": f"`{backend}`",
                "the demo's world": length(1e-3 * demo["after_take_off_mm"].iloc[0]),
                "other worlds": _spread(1e-3 * others["after_take_off_mm"]),
                "ATE, all": _ate(_in_m(own)),
                _NEES: _parts(own, "nees", ".2f", axes=3),
                "resets": f"{own['resets'].sum()}",
            }
        )
    return markdown(shown) + source(rows)


def loops() -> str:
    """What loops made of the odometry's own path; each flight's runs, and all."""
    rows = _in_m(recorded("loops.json"))
    shown = []
    flights = [(f"{clip}, `{backend}`", own) for (clip, backend), own in rows.groupby(["clip", "backend"], sort=False)]
    for name, own in (*flights, ("all", rows)):
        ratios = own["ratio"].fillna(1.0)
        shown.append(
            {
                "flight, back-end": name,
                "n": f"{len(own)}",
                "ATE": "-" if name == "all" else _spread(own["ate_m"]),
                "with loops": "-" if name == "all" else _spread(1e-3 * own["ate_loops_mm"]),
                "ratio, mean": f"{ratios.mean():.2f}",
                "largest": f"{ratios.max():.2f}",
                "above 1.02": f"{(ratios > 1.02).sum()}",
                "loops a run": f"{own['loops'].mean():.0f}",
            }
        )
    return markdown(shown) + source(rows)


def april() -> str:
    """The AprilGrid board."""
    rows = recorded("april_*.json")
    shown = [
        {
            "back-end": f"`{row.backend}`",
            "initialised after": f"{row.initialised_s:.2f} s",
            "resets": f"{row.resets}",
            "truth by the lens": row.lens,
            "fits the corners to": f"{row.pnp_px:.2f} px",
            "turns unlike the gyroscope by": f"{row.turned_deg:.2f} deg",
            "ATE": length(row.ate_m),
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def truth_clocks() -> str:
    """How late positions of the truth are, and the clip that was flown against it as stamped and on time."""
    rows = recorded("truth_clocks.json")
    shown = [
        {
            "recording": row["recording"],
            "positions late by": f"{row['late_ms']:.1f} ± {row['sigma_ms']:.1f} ms",
            "at its speed": length(1e-3 * abs(row["late_ms"]) * row["speed_m_s"]),
            **{
                f"`{backend}`": "-"
                if pd.isna(row[f"{backend}.ate_mm"])
                else " -> ".join(length(1e-3 * row[f"{backend}.{name}"]) for name in ("ate_mm", "on_time_mm"))
                for backend in ("msckf", "sliding_window")
            },
        }
        for row in rows.to_dict("records")
    ]
    return markdown(shown) + source(rows)


def rolling_shutter() -> str:
    """ATE with a rolling shutter over that with a global one, and the readout that was estimated."""
    rows = recorded("rolling_shutter_*.json")
    shown = []
    for (flight, backend), own in rows.groupby(["flight", "backend"], sort=False):
        still = own[own["shutter"] == "global"]["ate_m"].mean()
        for shutter, found in own.groupby("shutter", sort=False):
            begun = found.dropna(subset=["ate_m"])
            readout = begun["readout_ms"] if "estimated" in str(shutter) else begun["readout_ms"].head(0)
            shown.append(
                {
                    "flight": str(flight),
                    "back-end": f"`{backend}`",
                    "shutter": str(shutter),
                    "begun": f"{len(begun)} of {len(found)}",
                    "ATE": _ate(begun) if len(begun) else "-",
                    "times that of the global shutter": _number(begun["ate_m"].mean() / still, ".2f"),
                    "readout": _range(readout, ".1f", "ms") if len(readout) else "-",
                }
            )
    return markdown(shown) + source(rows)


def starts() -> str:
    """Starts anywhere, by recording and by what the calibration has wrong."""
    rows = recorded("starts_*.json")
    shown = [
        {
            "recording": str(row.recording),
            "wrong": str(row.fault),
            "starts": f"{row.starts:.0f}",
            "in time": _number(row.in_time_percent, ".0f") + " %",
            "after, median and longest": f"{_number(row.after_s, '.1f')} and {_number(row.slowest_s, '.1f')} s",
            "never": _number(row.never, ".0f"),
            "scale, median": f"{_number(row.scale_percent, '.1f')} %",
            "worst": f"{_number(row.worst_scale_percent, '.1f')} %",
            "bad": _number(row.bad, ".0f"),
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def frontend() -> str:
    """The front-end by detector and threads."""
    rows = recorded("frontend_speed*.json")
    shown = [
        {
            "detector": f"`{row['detector']}`",
            "threads": f"{row['threads']}",
            **{
                f"{stage} ms": f"{row[f'ms.{stage}']:.1f}" for stage in ("equalise", "klt", "reject", "detect", "total")
            },
            "frames a track lives": f"{row['lifetime']:.0f}",
            "px off the epipolar line after 1, 5, 10 frames": ", ".join(
                row[f"px.{frames}"].partition(" /")[0] for frames in (1, 5, 10)
            ),
        }
        for _, row in rows.iterrows()
    ]
    return markdown(shown) + source(rows)


def tracks() -> str:
    """How long each detector's tracks live and how far they stray: means over worlds, and over Shi-Tomasi's."""
    rows = recorded("tracks.json")
    measures = (
        ("images lived", "life.median", ".1f"),
        ("px off", "drift_px.median", ".2f"),
        ("px off, 95 %", "drift_px.p95", ".2f"),
    )
    beside = rows[rows["detector"] == "shi_tomasi"].set_index(["condition", "world"])
    shown = []
    for (condition, detector), own in rows.groupby(["condition", "detector"], sort=False):
        paired = own.set_index(["condition", "world"])
        row = {"condition": str(condition).replace("_", " "), "detector": f"`{detector}`", "n, worlds": f"{len(own)}"}
        for name, column, spec in measures:
            ratios = paired[column] / beside.loc[paired.index, column]
            row[name] = f"{own[column].mean():{spec}} ({geometric_mean(ratios):.2f})"
        shown.append(row)
    return markdown(shown) + source(rows)


def whole_runs() -> str:
    """Whole runs on one core and on two, beside the yardstick; medians over the rounds."""
    rows = recorded("speed.json")
    shown = [
        {
            "data": row.data,
            "run": row.run,
            "cores": f"{row.cores}",
            "n": f"{row.rounds}",
            "ms a frame": _within(row.frame_ms, row.lowest_ms, row.highest_ms, ".1f"),
            "of the yardstick": _number(row.by_yardstick, ".2f"),
            "frames/s": _number(row.frames_s, ".0f"),
            "times real time": _number(row.real_time, ".1f"),
            "first frame, s": _number(row.first_s, ".2f"),
            "ratio": _number(row.ratio, ".2f"),
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def first_frame() -> str:
    """What a run waits for before its first frame."""
    rows = recorded("first_frame.json")
    shown = [
        {
            "what": row.what,
            "n": f"{row.rounds}",
            "seconds": _within(row.seconds, row.lowest_s, row.highest_s, ".2f"),
        }
        for row in _each(rows.sort_values("seconds", ascending=False))
    ]
    return markdown(shown) + source(rows)


def consistency() -> str:
    """Monte Carlo: errors, and NEES a degree of freedom with the band of an honest filter and the verdict."""
    rows = recorded("montecarlo*.json")

    def nees(row: pd.Series, part: str) -> str:
        dof, (low, high) = row[f"nees.{part}.dof"], row[f"nees.{part}.band_95"]
        verdict = row[f"nees.{part}.verdict"]
        return f"{row[f'nees.{part}.per_axis']:.2f} of {low / dof:.2f} to {high / dof:.2f}: {verdict}"

    shown = [
        {
            "flight": row["setup.flight"],
            "back-end": f"`{row['name']}`",
            "n": f"{row['trials']}",
            "failed": f"{sum(row[name] for name in rows.columns if name.startswith('failures.'))}",
            "ATE": _spread([trial["ate_m"] for trial in row["by_seed"] if trial["failure"] is None]),
            "orientation": f"{row['orientation_deg']:.2f} deg",
            **{f"NEES of {part}": nees(row, part) for part in ("orientation", "position", "pose")},
        }
        for _, row in rows.iterrows()
    ]
    return markdown(shown) + source(rows)


def memory() -> str:
    """How memory grows in a long flight."""
    rows = recorded("memory*.json")
    shown = [
        {
            "back-end": f"`{row.backend}`" + (f" with `{row.loop_closer}`" if row.loop_closer else ""),
            "flight": f"{row.minutes:.0f} min",
            "after a minute": f"{row.first_minute_mb:.0f} MB",
            "grown since": f"{row.grown_mb:.1f} MB",
            "landmarks in the map": f"{row.landmarks}",
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def live() -> str:
    """Minutes of a live flight, as it is, with a slow back-end, watched, and by an emulated camera."""
    rows = recorded("live*.json")
    shown = [
        {
            "flown": row["case"],
            "back-end": f"`{row['backend']}`",
            "frames dropped": f"{row['frames_dropped']:.0f} of {row['frames']:.0f}",
            "readings lost": f"{row['readings_lost']:.0f}",
            "tracked": f"{row['completion']:.1%}",
            "ATE": length(1e-3 * row["ate_mm"]),
            "exposure to estimate, median, 99 %": f"{row['latency_ms.median']:.0f}, {row['latency_ms.p99']:.0f} ms",
            "memory after a minute, at the end": f"{row['minute_mib']:.0f}, {row['end_mib']:.0f} MiB",
            "the same bytes again": row["same_bytes"],
        }
        for _, row in rows.iterrows()
    ]
    return markdown(shown) + source(rows)


def push() -> str:
    """Measurements pushed from Python against the command line."""
    rows = recorded("odometry_speed.json")
    shown = [
        {
            "way": row.way,
            "n, runs": f"{row.rounds}",
            "ms a frame, median": _within(row.frame_ms, row.lowest_ms, row.highest_ms, ".1f"),
            "times the command line": f"{row.ratio:.2f}",
            "the same bytes": row.same_bytes,
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def speed() -> str:
    """Every detector on each kind of images, the fastest first, and on which of them it is faster than the baseline."""
    return _speeds("detectors_speed.json")


def speed_gpu() -> str:
    """The same, of KeypointNet on a GPU."""
    return _speeds("detectors_speed_gpu.json")


def _speeds(name: str) -> str:
    rows = recorded(name).sort_values("fps", ascending=False)
    kinds = list(dict.fromkeys(recorded(name)["images"]))
    theirs = rows[rows["detector"] == BASELINE].set_index("images")["fps_high"]
    shown = []
    for detector, own in rows.groupby("detector", sort=False):
        each = {row.images: row for row in _each(own)}
        faster = ", ".join(kind for kind in kinds if each[kind].fps_low > theirs[kind])
        told = {f"faster than `{BASELINE}` on": faster or "-", "on": own["on"].iloc[0]}
        shown.append({"detector": f"`{detector}`", **{kind: _pace(each[kind].fps) for kind in kinds}, **told})
    return markdown(shown) + source(rows)


def _pace(fps: float) -> str:
    return f"{fps:.0f} ({1e3 / fps:.{1 if fps > 100.0 else 0}f} ms)"


def quality() -> str:
    """Repeatability of every detector under every degradation, the best in bold."""
    rows = recorded("detectors_quality.json")
    table = by_degradation(rows.drop(columns=["lead_repeatability"]), "repeatability", ".3f").set_index("degradation")
    best = table.astype(float).eq(table.astype(float).max(axis=1), axis=0)
    table = table.where(~best, "**" + table + "**").rename(columns=lambda name: f"`{name}`")
    shown = table.reset_index().rename(columns={"degradation": ""}).to_dict("records")
    return markdown(shown) + source(rows)


def clean() -> str:
    """Every detector on images as they are."""
    rows = recorded("detectors_quality.json")
    rows = rows[rows["degradation"] == Degradation().name].sort_values("repeatability", ascending=False)
    shown = [
        {
            "": f"`{row.detector}`",
            "repeatability": f"{row.repeatability:.3f}",
            "of distinct points": f"{row.distinct:.3f}",
            "localisation px": f"{row.localisation_px:.2f}",
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


def comparison() -> str:
    """The suite ``mh05_comparison``: accuracy over its worlds, and who won in how many of them."""
    table = pd.read_csv(HERE / "results" / "mh05_comparison" / "accuracy.csv")
    against = {(row["detector"], row["back-end"]): row for _, row in _duels("mh05_comparison").iterrows()}
    shown = [
        {
            "sequence": f"{row['sequence']}, {row['data']}",
            "back-end": f"`{row['back-end']}`",
            "detector": f"`{row['detector']}`",
            "n": f"{row['seeds']}",
            "ATE, mean": f"{1e3 * row['ATE, position + yaw [m]']:.1f} ± {1e3 * row['std [m]']:.1f} mm",
            "of the path": f"{row['ATE [% of path]']:.3f} %",
            "completion": f"{row['completion [%]']:.0f} %",
            "over that of `shi_tomasi`": "-" if duel is None else _with_interval(duel),
            "won - lost": "-" if duel is None else f"{duel['won']} - {duel['lost']}",
        }
        for _, row in table.iterrows()
        for duel in [against.get((row["detector"], row["back-end"]))]
    ]
    # Geometric means over the same worlds: the quotient of two is that of one detector to the other.
    rival = "shi_tomasi:min_distance_px=4"
    over = [
        f"{against['keypointnet', backend]['ratio'] / against[rival, backend]['ratio']:.2f} (`{backend}`)"
        for backend in table["back-end"].unique()
    ]
    told = f"\nOver that of `{rival}`, `keypointnet` has {', '.join(over)}.\n"
    return markdown(shown) + told + suite_source("mh05_comparison")


def stress() -> str:
    """The suite ``stress``: the ATE over Shi-Tomasi's by condition, with its interval over the worlds."""
    shown: dict[str, dict[str, str]] = {}
    for _, row in _duels("stress").iterrows():
        at = shown.setdefault(row["condition"], {"": row["condition"]})
        at[f"`{row['detector']}`, `{row['back-end']}`"] = _with_interval(row)
    return markdown(shown.values()) + suite_source("stress")


def contest() -> str:
    """The same over all degraded flights together, with who won."""
    table = _duels("stress")
    shown = [
        {
            "detector": f"`{row['detector']}`",
            "back-end": f"`{row['back-end']}`",
            "ATE over that of `shi_tomasi`": _with_interval(row),
            "n, pairs": f"{row['of pairs']}",
            "won - lost": f"{row['won']} - {row['lost']}",
            "p, Holm": "< 0.001" if row["p, Holm"] < 5e-4 else f"{row['p, Holm']:.3f}",
        }
        for _, row in table[table["condition"] == "all degraded"].iterrows()
    ]
    return markdown(shown) + suite_source("stress")


def exact_points() -> str:
    """What is left of Shi-Tomasi's error in the suite ``stress`` where its points are exact, by condition."""
    rows = recorded("exact_points.json")
    rows = rows.assign(ratio=rows["exact_mm"] / rows["ate_mm"])
    degraded = rows[rows["condition"] != "clear"].assign(condition="all degraded")
    shown = [
        {"": str(condition)}
        | {f"`{name}`": f"{geometric_mean(of['ratio']):.2f} (n = {len(of)})" for name, of in own.groupby("backend")}
        for condition, own in pd.concat([rows, degraded]).groupby("condition", sort=False)
    ]
    return markdown(shown) + source(rows)


def foresight() -> str:
    """The ATE over Shi-Tomasi's by KeypointNet, and by points whose fate is known, by condition."""
    rows = recorded("foresight.json")
    ates = rows.pivot_table(index=["condition", "world"], columns=["detector", "backend"], values="ate_mm", sort=False)
    conditions = ates.index.get_level_values("condition")
    degraded = ates.loc[conditions != "clear"]
    shown = [
        {"": str(condition)}
        | {
            f"`{name}`, `{backend}`": f"{geometric_mean(of[name, backend] / of['shi_tomasi', backend]):.2f}"
            for name, backend in of
            if name != "shi_tomasi"
        }
        | {"n": f"{len(of)}"}
        for condition, of in [*ates.groupby("condition", sort=False), ("all degraded", degraded)]
    ]
    return markdown(shown) + source(rows)


def tuning() -> str:
    """The suite ``tuning``."""
    return _variants("tuning")


def targets_flown() -> str:
    """The suite ``targets``."""
    return _variants("targets")


def _variants(suite: str) -> str:
    """What each detector of it reaches by the first one's ATE, in the clear and in all that is degraded."""
    table = _duels(suite)
    ratios = table.pivot_table(index="detector", columns=["back-end", "condition"], values="ratio", sort=False)
    conditions = "clear", "all degraded"
    shown = [
        {"": f"`{detector}`"}
        | {
            f"`{backend}`, {', '.join(conditions)}": ", ".join(f"{row[backend, each]:.2f}" for each in conditions)
            for backend in table["back-end"].unique()
        }
        for detector, row in ratios.iterrows()
    ]
    return markdown(shown) + suite_source(suite)


def targets() -> str:
    """How networks order points that are followed by what became of these: one for each target, and those that ship."""
    rows = recorded("targets.json")
    names = rows.loc[rows["steps"] > 0, "trained for"]
    shown = [
        {"trained for": row["trained for"]} | {f"order by {name}": f"{row[f'order.{name}']:.2f}" for name in names}
        for _, row in rows.iterrows()
    ]
    return markdown(shown) + source(rows)


def _duels(suite: str) -> pd.DataFrame:
    """What its table of duels says, the column of the ATE over the baseline's as ``ratio``."""
    table = pd.read_csv(HERE / "results" / suite / "duels.csv")
    return table.rename(columns=lambda name: "ratio" if name.startswith("ATE over that of") else name)


def _with_interval(row: pd.Series) -> str:
    return f"{row['ratio']:.2f} ({row['95 % from']:.2f} to {row['to']:.2f})"


def throughput() -> str:
    """How a sweep gains from a second worker."""
    rows = recorded("sweep_throughput_*.json")
    shown = [
        {
            "workers": f"{row.workers}",
            "flights": f"{row.flights}",
            "seconds": f"{row.seconds:.0f}",
            "times one worker": f"{row.times_one:.2f}",
        }
        for row in _each(rows)
    ]
    return markdown(shown) + source(rows)


FIGURES: dict[str, Callable[[], str]] = {
    make.__name__: make
    for make in (
        *(
            headline,
            real_images,
            stages,
            at_rest,
            landmarks,
            rendered,
            one_or_two,
            error_budget,
            take_off,
            loops,
            april,
            truth_clocks,
            frontend,
            tracks,
            whole_runs,
            first_frame,
            consistency,
            memory,
            live,
            push,
        ),
        *(
            speed,
            speed_gpu,
            quality,
            clean,
            comparison,
            tuning,
            targets,
            targets_flown,
            stress,
            contest,
            exact_points,
            foresight,
            throughput,
            rolling_shutter,
            planted_faults,
            starts,
        ),
    )
}


def recorded(pattern: str) -> pd.DataFrame:
    """The results in ``results/PATTERN``, a row each; nested figures are columns such as ``ms.klt``.

    ``file``, ``commit`` and ``date`` say where a row is from, ``backend`` what made it where the record is of one.
    """
    found = []
    for path in sorted((HERE / "results").glob(pattern)):
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = pd.json_normalize([row for row in content["results"] if "absent" not in row])
        about = {"file": path.name, "commit": content["machine"]["commit"], "date": content["recorded"][:10]}
        if "backend" in content["settings"] and "backend" not in rows:
            about["backend"] = content["settings"]["backend"]
        if "images" in content["settings"]:  # of one kind, as the rows do not say
            about["images"] = content["settings"]["images"]
        found.append(rows.assign(**about))
    if not found:
        raise FileNotFoundError(pattern)
    return pd.concat(found, ignore_index=True)


def source(*records: pd.DataFrame) -> str:
    """The line below a table that says which records it is made of."""
    files = pd.concat([rows[["file", "commit", "date"]] for rows in records]).drop_duplicates()
    told = (f"`{row.file}` ({_revision(row.commit)}, {row.date})" for row in _each(files))
    return f"\nFrom {', '.join(told)} in `benchmarks/results`.\n"


def suite_source(name: str) -> str:
    """The same for the tables of a suite."""
    about = pd.read_csv(HERE / "results" / name / "provenance.csv")
    commits = [_revision(commit) for commit in about.loc[about["what"] == "commit", "value"]]
    return f"\nFrom `{name}/` ({', '.join(commits)}) in `benchmarks/results`.\n"


def _revision(commit: str | None) -> str:
    if commit is None:  # made outside of a checkout
        return "revision not recorded"
    revision, _, dirty = commit.partition("-")
    return revision[:8] + (" with changes" if dirty else "")


def markdown(rows: Iterable[dict[Any, str]]) -> str:
    table = pd.DataFrame(list(rows)).fillna("-")
    lines = [list(table.columns), ["---"] * len(table.columns), *table.to_numpy().tolist()]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _each(rows: pd.DataFrame) -> Iterable[Any]:
    """The rows, whose attributes are named as the columns."""
    return rows.itertuples()


def _by_backend(rows: pd.DataFrame) -> Iterable[tuple[str, pd.DataFrame]]:
    return ((str(backend), own) for backend, own in rows.groupby("backend"))


def _in_m(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.assign(ate_m=1e-3 * rows["ate_mm"])


def _ate(rows: pd.DataFrame) -> str:
    return _spread(rows["ate_m"])


def _spread(ate_m: Iterable[float]) -> str:
    """Mean and sample standard deviation, and of how many; of a single one just the value."""
    values = pd.Series(list(ate_m), dtype=float)
    of_many = f" (n = {len(values)})" if len(values) > 1 else ""
    return f"{length(values.mean(), values.std())}{of_many}"


def _within(median: float, lowest: float, highest: float, spec: str) -> str:
    """A median, with the lowest and the highest beside it."""
    return f"{median:{spec}} ({lowest:{spec}} to {highest:{spec}})"


def _parts(rows: pd.DataFrame, what: str, spec: str, *, axes: int = 1) -> str:
    """The median of a figure of orientation, and of one of position, over the number of ``axes`` that it sums."""
    return ", ".join(format(rows[f"{what}.{part}"].median() / axes, spec) for part in ("orientation", "position"))


def _range(values: pd.Series, spec: str, unit: str) -> str:
    low, high = format(values.min(), spec), format(values.max(), spec)
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _mean(rows: pd.DataFrame, column: str) -> str:
    return f"{rows[column].mean():.1f} m"


def _number(value: float, spec: str) -> str:
    return "-" if pd.isna(value) else format(value, spec)


def page(text: str) -> str:
    """``text`` with every block of figures made anew."""

    def block(found: re.Match[str]) -> str:
        try:
            return found[1] + FIGURES[found[2]]() + found[3]
        except FileNotFoundError:
            return f"{found[1]}Nothing is recorded yet.\n{found[3]}"

    return BLOCK.sub(block, text)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(page(path.read_text(encoding="utf-8")), encoding="utf-8")
