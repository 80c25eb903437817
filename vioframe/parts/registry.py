"""Finds the parts: detectors, back-ends, readers and the others come in by name through ``vioframe`` entry points.

pluggy finds the parts once and checks the hooks; after that the names are looked up in plain tables and the parts are
called directly. A plug-in that cannot be loaded never takes the others down: it is skipped with a warning and listed
with the reason.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field, replace
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, entry_points
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import numpy as np
import pluggy

from vioframe.errors import DatasetError, PluginError, VioframeError, shown
from vioframe.interfaces import Backend, Dataset, Detector, Flight, LoopCloser, Metric, Source, Trainer, World
from vioframe.parts import hooks as hookspecs
from vioframe.parts.options import Option, did_you_mean, options_of, plugin_factory, validate_options
from vioframe.types import Calibration, Float

__all__ = ["KINDS", "Failure", "Kind", "Option", "Part", "Registry", "load", "options_of", "plugin_factory"]

_LOG = logging.getLogger(__name__)

_ABSENT = object()


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of part: its hook, its interface, and how many leading arguments of a factory the framework fills in."""

    name: str
    hook: str
    interface: type
    given: int


DETECTOR = Kind("detector", "vioframe_detectors", Detector, 0)
BACKEND = Kind("backend", "vioframe_backends", Backend, 0)
LOOP_CLOSER = Kind("loop closer", "vioframe_loop_closers", LoopCloser, 1)
DATASET = Kind("dataset", "vioframe_datasets", Dataset, 1)
SOURCE = Kind("source", "vioframe_sources", Source, 1)
FLIGHT = Kind("flight", "vioframe_flights", Flight, 2)
WORLD = Kind("world", "vioframe_worlds", World, 2)
METRIC = Kind("metric", "vioframe_metrics", Metric, 0)
TRAINER = Kind("trainer", "vioframe_trainers", Trainer, 1)
_GIVEN = {
    LOOP_CLOSER.name: "the calibration",
    DATASET.name: "the path",
    SOURCE.name: "the address",
    FLIGHT.name: "duration_s and R_LB",
    WORLD.name: "p_WB and rng",
    TRAINER.name: "the job",
}
"""What the framework fills in."""
KINDS = (DETECTOR, BACKEND, LOOP_CLOSER, DATASET, SOURCE, FLIGHT, WORLD, METRIC, TRAINER)


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a plug-in comes from: its entry point and the distribution that declares it."""

    entry_point: str
    module: str
    distribution: str
    version: str

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}"


@dataclass(frozen=True, slots=True)
class Part:
    """A named part, and where it comes from; ``own_name`` is what its plug-in calls it, as others may as well."""

    kind: Kind
    name: str
    factory: Any
    origin: Origin
    own_name: str

    def __str__(self) -> str:
        return f"{self.kind.name} {self.name!r} ({self.origin})"

    @property
    def options(self) -> list[Option]:
        return options_of(self.factory, self.kind.given)

    def validate(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """``options`` checked, coerced and completed with the defaults."""
        return validate_options(f"{self.kind.name} {self.name!r}", self.factory, options, self.kind.given)

    def create(self, *given: Any, options: Mapping[str, Any]) -> Any:
        """Build the part; raises :class:`PluginError` where its factory fails or makes something else."""
        complete = self.validate(options)
        try:
            part = self.factory(*given, **complete)
        except VioframeError:
            raise
        except Exception as error:
            raise PluginError(f"{self} could not be created: {describe(error)}") from error
        missing = [
            name
            for name in vars(self.kind.interface)
            # Statically: looking at a property of a data set would already read from it.
            if not name.startswith("_") and inspect.getattr_static(part, name, _ABSENT) is _ABSENT
        ]
        if missing:
            raise PluginError(f"{self} made a {type(part).__name__}, which has no {', '.join(missing)}")
        return part


@dataclass(frozen=True, slots=True)
class Failure:
    """A plug-in that was skipped, and why."""

    origin: Origin
    reason: str


@dataclass(frozen=True, slots=True)
class Clash:
    """A name that several parts of one kind have, and what to call them by instead."""

    kind: Kind
    name: str
    instead: tuple[str, ...]

    def __str__(self) -> str:
        return f"several plug-ins provide a {self.kind.name} called {self.name!r}; say {' or '.join(self.instead)}"


@dataclass(frozen=True, slots=True)
class Registry:
    """The tables of all installed parts, by kind and name, and the plug-ins that failed to load.

    A name that several plug-ins give to parts of one kind is none's alone: each is there as ``NAME@DISTRIBUTION``, and
    the name is among the ``clashes``.
    """

    parts: Mapping[str, Mapping[str, Part]] = field(default_factory=dict)
    failures: tuple[Failure, ...] = ()
    clashes: tuple[Clash, ...] = ()

    def names(self, kind: Kind) -> list[str]:
        return sorted(self.parts.get(kind.name, {}))

    def find(self, kind: Kind, name: str) -> Part:
        """The part of that name; raises :class:`PluginError` listing what is installed."""
        table = self.parts.get(kind.name, {})
        if name in table:
            return table[name]
        if clash := next((each for each in self.clashes if (each.kind, each.name) == (kind, name)), None):
            raise PluginError(str(clash))
        what = "reader" if kind is DATASET else kind.name
        raise PluginError(
            f"no {what} is called {shown(name)}{did_you_mean(name, table)}; "
            f"installed: {', '.join(sorted(table)) or 'none'}{self._failure_hint()}"
        )

    def create_detector(self, name: str, options: Mapping[str, Any] | None = None) -> Detector:
        return cast(Detector, self.find(DETECTOR, name).create(options=options or {}))

    def create_backend(self, name: str, options: Mapping[str, Any] | None = None) -> Backend:
        return cast(Backend, self.find(BACKEND, name).create(options=options or {}))

    def create_loop_closer(
        self, name: str, calibration: Calibration, options: Mapping[str, Any] | None = None
    ) -> LoopCloser:
        return cast(LoopCloser, self.find(LOOP_CLOSER, name).create(calibration, options=options or {}))

    def create_flight(
        self, name: str, duration_s: float, R_LB: Float, options: Mapping[str, Any] | None = None
    ) -> Flight:
        return cast(Flight, self.find(FLIGHT, name).create(duration_s, R_LB, options=options or {}))

    def create_world(
        self, name: str, p_WB: Float, rng: np.random.Generator, options: Mapping[str, Any] | None = None
    ) -> World:
        return cast(World, self.find(WORLD, name).create(p_WB, rng, options=options or {}))

    def open_dataset(
        self, path: str | Path, reader: str | None = None, options: Mapping[str, Any] | None = None
    ) -> Dataset:
        """Open the recording at ``path`` with the reader of that name, or with the one that accepts it.

        Of a ``path`` that is ``NAME:ADDRESS`` it is a live :class:`~vioframe.interfaces.Source`, not started yet, or
        where a reader is called so the recording ``ADDRESS``.
        """
        part, given = self.resolve(path, reader)
        return cast(Dataset, part.create(given, options=options or {}))

    def resolve(self, path: str | Path, reader: str | None = None) -> tuple[Part, str | Path]:
        """The reader or live source to open ``path`` with, and what to give it: a recording, or an address.

        Raises :class:`DatasetError` saying what is wrong.
        """
        name, colon, address = str(path).partition(":")
        path = Path(path)
        if not path.exists():
            if not colon or "/" in name:
                raise DatasetError(f"{path} does not exist")
            if name not in self.names(DATASET):
                return self.find(SOURCE, name), address
            if not address:
                raise DatasetError(f"no recording named: {name}:FILE")
            return self.resolve(address, name)
        if reader is not None:
            return self.find(DATASET, reader), path
        accepting = [part for part in self.parts.get(DATASET.name, {}).values() if _accepts(part, path)]
        if len(accepting) == 1:
            return accepting[0], path
        if accepting:
            names = ", ".join(sorted(part.name for part in accepting))
            raise DatasetError(f"several readers accept {path}: {names}; choose one with --reader")
        readers = ", ".join(self.names(DATASET)) or "none"
        raise DatasetError(f"{path} {_what_is_wrong(path)}; readers: {readers}{self._failure_hint()}")

    def blame(self, trace: TracebackType | None) -> Origin | None:
        """The plug-in in whose code an exception was last under way, or None where no plug-in was involved."""
        modules = {part.origin.module: part.origin for table in self.parts.values() for part in table.values()}
        culprit = None
        while trace is not None:
            name = str(trace.tb_frame.f_globals.get("__name__", ""))
            culprit = next((s for m, s in modules.items() if name == m or name.startswith(f"{m}.")), culprit)
            trace = trace.tb_next
        return culprit

    @contextmanager
    def blaming(self) -> Iterator[None]:
        """What a plug-in raises within comes out as a :class:`PluginError` that names it."""
        try:
            yield
        except VioframeError:
            raise
        except (Exception, SystemExit) as error:
            if _is_interrupt(error):
                raise KeyboardInterrupt from error
            origin = self.blame(error.__traceback__)
            if origin is None:
                raise
            raise PluginError(f"plug-in {origin.entry_point!r} ({origin}) failed: {describe(error)}") from error

    def _failure_hint(self) -> str:
        if not self.failures:
            return ""
        broken = ", ".join(sorted(failure.origin.entry_point for failure in self.failures))
        return f" (failed to load: {broken}; `vioframe plugins` says why)"


def load(found: Iterable[EntryPoint] | None = None) -> Registry:
    """Load every plug-in of the ``vioframe`` entry-point group; one that is not in order is skipped with a warning."""
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    every: list[Part] = []
    failures = []
    chosen = entry_points(group=hookspecs.PROJECT) if found is None else found
    # One at a time: pluggy's own loader gives up on all of them at the first ImportError.
    for origin, entry in sorted(((_origin(entry), entry) for entry in chosen), key=lambda pair: astuple(pair[0])):
        try:
            every += _parts_of(manager, origin, entry.load())
        except Exception as error:
            failures.append(Failure(origin, str(error) if isinstance(error, PluginError) else describe(error)))
            _LOG.warning("plug-in %s (%s) is skipped: %s", origin.entry_point, origin, failures[-1].reason)
    parts: dict[str, dict[str, Part]] = {kind.name: {} for kind in KINDS}
    clashes = []
    for (kind, name), named in _by_name(every).items():
        for part in named:
            parts[kind.name][part.name] = part
        if len(named) > 1:
            clashes.append(Clash(kind, name, tuple(part.name for part in named)))
    return Registry(parts, tuple(failures), tuple(clashes))


def load_alone(origin: Origin) -> Registry:
    """One plug-in, without importing the others: its parts have the :attr:`Part.own_name` that it gives them."""
    return load(entry for entry in entry_points(group=hookspecs.PROJECT) if _origin(entry) == origin)


def _by_name(every: Iterable[Part]) -> dict[tuple[Kind, str], list[Part]]:
    """The parts of each kind and name, those that share one renamed after where they come from."""
    table: dict[tuple[Kind, str], list[Part]] = {}
    for part in every:
        table.setdefault((part.kind, part.name), []).append(part)
    for named in table.values():
        if len(named) > 1:
            distributions = {part.origin.distribution for part in named}
            apart = len(distributions) == len(named)
            named[:] = [
                replace(part, name=f"{part.name}@{part.origin.distribution if apart else part.origin.entry_point}")
                for part in named
            ]
    return table


def describe(error: BaseException) -> str:
    """An exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _parts_of(manager: pluggy.PluginManager, origin: Origin, plugin: Any) -> list[Part]:
    """Register one plug-in and ask its hooks for its parts; raises :class:`PluginError` where it is not in order."""
    identity = f"{origin.distribution}:{origin.entry_point}"
    manager.register(plugin, identity)
    try:
        manager.check_pending()
        hooks = [caller.name for caller in manager.get_hookcallers(plugin) or []]
        if not hooks:
            raise PluginError("it implements no hook; decorate its functions with @vioframe.parts.hooks.hookimpl")
        return [
            Part(kind, name, _checked(kind, name, factory), origin, name)
            for kind in KINDS
            if kind.hook in hooks
            for name, factory in _offered(kind, getattr(plugin, kind.hook)()).items()
        ]
    except pluggy.PluginValidationError as error:
        known = [kind.hook for kind in KINDS]
        unknown = next(n for n in dir(plugin) if manager.parse_hookimpl_opts(plugin, n) and n not in known)
        hint = did_you_mean(unknown, known)
        raise PluginError(f"there is no hook {unknown!r}{hint}; hooks: {', '.join(known)}") from error
    finally:
        # What it offers is known now; a broken one must not trip the check of the next.
        manager.unregister(name=identity)


def _offered(kind: Kind, answer: Any) -> Mapping[Any, Any]:
    if not isinstance(answer, Mapping):
        raise PluginError(f"{kind.hook}() must return a dict, from names to factories, not a {type(answer).__name__}")
    return answer


def _checked(kind: Kind, name: object, factory: Any) -> Any:
    if not isinstance(name, str) or not name or not callable(factory):
        raise PluginError(f"{kind.hook} must map names to callables, got {name!r}: {factory!r}")
    if kind is DATASET and not callable(getattr(factory, "accepts", None)):
        raise PluginError(f"the reader {name!r} has no accepts(path)")
    # Raises ValueError for the few callables that have none, hence no options to read.
    parameters = inspect.signature(factory).parameters.values()
    placed = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(placed) < kind.given and not any(p.kind is p.VAR_POSITIONAL for p in parameters):
        raise PluginError(f"the factory of the {kind.name} {name!r} must take {_GIVEN[kind.name]} ahead of its options")
    if kind is BACKEND and any(p.name == "calibration" and p.default is p.empty for p in placed):
        raise PluginError(f"the factory of the backend {name!r} asks for a calibration, which comes with begin(start)")
    return factory


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is what began it: within compiled code it comes out as a SystemError, or as one behind another."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _origin(entry: EntryPoint) -> Origin:
    return Origin(entry.name, entry.module, *(_name_and_version(entry.dist) if entry.dist else ("unknown", "?")))


@lru_cache(maxsize=16)
def _name_and_version(distribution: Distribution) -> tuple[str, str]:
    facts = distribution.metadata  # each look at it reads a file, and most plug-ins come in one distribution
    return facts["Name"], facts["Version"]


def _accepts(part: Part, path: Path) -> bool:
    try:
        return bool(part.factory.accepts(path))
    except Exception as error:
        _LOG.warning("%s failed to look at %s: %s", part, path, describe(error))
        return False


def _what_is_wrong(path: Path) -> str:
    if path.is_dir():
        if not any(path.iterdir()):
            return "is an empty folder"
        return "is a folder without mav0/ (an ASL data set) or metadata.yaml (a ROS 2 bag)"
    if path.stat().st_size == 0:
        return "is an empty file"
    return f"is not a recording any reader knows (its extension is {path.suffix or 'missing'!r})"
