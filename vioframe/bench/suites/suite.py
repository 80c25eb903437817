"""What a suite compares: YAML in, a frozen and validated :class:`Suite` out."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from vioframe.bench.montecarlo import Setup
from vioframe.errors import ConfigError
from vioframe.frontend import FrontendOptions
from vioframe.parts.config import LabelledPart, Named, PartConfig, Section, read_tree, validate
from vioframe.parts.options import did_you_mean, validate_options
from vioframe.runs.results import Reference
from vioframe.simulation.conditions import Conditions
from vioframe.simulation.config import RigName
from vioframe.simulation.seeds import Purpose

Kind = Literal["flights", "detector_speed", "trials"]
Level = Annotated[float, Field(gt=0.0, le=1.0)]


class Estimator(LabelledPart):
    """A back-end, which of EuRoC's cameras it sees by, and the loop closer behind it, if any."""

    loop_closure: PartConfig | None = None
    rig: RigName = "mono"


class Sequence(Named):
    """A sequence by name. ``start_s`` and ``duration_s`` None are those usual for it."""

    start_s: Annotated[float | None, Field(ge=0.0, allow_inf_nan=False)] = None
    duration_s: Annotated[float | None, Field(gt=0.0, allow_inf_nan=False)] = None


class Published(Section):
    """Figures of somebody else's, to be shown beside: ATE in metres by sequence, as ``alignment`` has it."""

    system: str
    alignment: str
    source: str
    ate_m: dict[str, float]


class Suite(Section):
    """Everything that determines a sweep but the data.

    ``flights`` runs every detector with every back-end on every sequence, as it is and under each of ``conditions`` at
    each level, ``seeds`` times; ``detector_speed`` times detectors; ``trials`` flies back-ends on simulated tracks.
    ``seeds_vary`` says what another seed changes: the ``start`` of the flight, by ``SEED_SHIFT_S``, or the simulated
    ``recording`` itself. What is simulated flies in ``worlds`` kept for that purpose. ``workers`` is for sweeps that
    must have it so, as one that measures time. ``reference`` is for the report: what somebody claims, quotes and shows;
    a suite's file may name another that holds it.
    """

    name: str
    title: str
    description: str = ""
    kind: Kind = "flights"
    detectors: tuple[LabelledPart, ...] = ()
    backends: tuple[Estimator, ...] = ()
    sequences: tuple[Sequence, ...] = ()
    conditions: dict[str, tuple[Level, ...]] = Field(default_factory=dict)
    clear: bool = True
    seeds: Annotated[int, Field(ge=1)] = 1
    seeds_vary: Literal["start", "recording"] = "start"
    worlds: Purpose = "reporting"
    metrics: tuple[str, ...] = ()
    frontend: dict[str, Any] = Field(default_factory=dict)
    workers: Annotated[int | None, Field(ge=1)] = None
    setup: Setup = Setup()
    rounds: Annotated[int, Field(ge=1)] = 10
    images: Annotated[int, Field(ge=1)] = 8
    published: tuple[Published, ...] = ()
    reference: Reference = Field(default_factory=Reference)

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if self.kind == "flights" and not (self.detectors and self.backends and self.sequences):
            raise ValueError("flights need detectors, backends and sequences")
        if self.kind == "trials" and not self.backends:
            raise ValueError("trials need backends")
        if self.kind == "trials" and any(backend.rig != "mono" for backend in self.backends):
            raise ValueError("backends: trials all fly the rig of their setup, as setup: {rig: stereo}")
        for what in ("detectors", "backends", "sequences"):
            names = [each.called for each in getattr(self, what)]
            if twice := next((name for name in names if names.count(name) > 1), None):
                raise ValueError(f"{what}: {twice!r} is named twice; give each a label of its own")
        if not (self.clear or self.conditions):
            raise ValueError("neither clear nor under a condition there is nothing to fly")
        for name, levels in self.conditions.items():
            Conditions.of({name: 1.0})
            if len(set(levels)) < len(levels):
                raise ValueError(f"conditions: {name} has a level twice")
        for key in sorted(self.model_fields_set - _ALWAYS - set(_USES[self.kind].split())):
            if getattr(self, key) != Suite.model_fields[key].get_default(call_default_factory=True):
                raise ValueError(f"{key} does nothing in a suite of kind {self.kind}")
        return self


SEED_SHIFT_S = 0.5
"""How much later a flight starts with each seed, where seeds vary the start."""

_USES: dict[Kind, str] = {
    "flights": "detectors backends sequences conditions clear seeds seeds_vary worlds metrics frontend workers "
    "published",
    "detector_speed": "detectors sequences rounds images",
    "trials": "backends seeds setup workers",
}
_ALWAYS = {"name", "title", "description", "kind", "reference"}


def shipped() -> dict[str, Path]:
    """The suites that come with vioframe, by name."""
    packaged = Path(str(files("vioframe"))) / "data" / "suites"
    # In a checkout they are where people look for them.
    folder = packaged if packaged.is_dir() else Path(__file__).parents[3] / "benchmarks" / "suites"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def find(name: str, others: Iterable[str] = ()) -> Path:
    """The suite called ``name``, or the file of that name.

    Raises :class:`ConfigError`; ``others`` are names beside the suites' that may have been meant.
    """
    suites = shipped()
    if name in suites:
        return suites[name]
    if Path(name).suffix in (".yaml", ".yml"):
        return Path(name)
    hint = did_you_mean(name, [*suites, *others])
    raise ConfigError(f"no suite is called {name!r}{hint}; there are {', '.join(suites)}; or name a YAML file")


def read(path: Path) -> Suite:
    """Raises :class:`ConfigError` naming the key that is wrong."""
    tree = {"name": path.stem} | read_tree(path)
    if isinstance(tree.get("reference"), str):
        tree["reference"] = read_tree(path.parent / tree["reference"])
    suite = validate(Suite, tree, str(path))
    FrontendOptions(**validate_options("the front-end", FrontendOptions, suite.frontend))
    return suite


def narrowed(suite: Suite, *, seeds: int | None = None, **only: Iterable[str]) -> Suite:
    """``suite`` with ``only`` those detectors, backends and sequences, or all where none is named.

    Raises :class:`ConfigError` for what it lacks.
    """
    changes: dict[str, Any] = {} if seeds is None else {"seeds": seeds}
    for kind, names in only.items():
        have = {each.called: each for each in getattr(suite, kind)}
        if not have and suite.kind == "detector_speed":
            have = {name: LabelledPart(name=name) for name in names}  # it names none and means all
        for name in names:
            if name not in have:
                there = f"; it has {', '.join(have)}" if have else ""
                raise ConfigError(f"the suite {suite.name} has no {name!r} among its {kind}{there}")
        if names:
            changes[kind] = tuple(each for name, each in have.items() if name in names)
    return suite.model_copy(update=changes)
