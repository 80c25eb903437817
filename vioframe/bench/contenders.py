"""Back-ends to compare, from what is written on the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vioframe.errors import ConfigError
from vioframe.parts import config as configuration
from vioframe.parts.config import Config, PartConfig
from vioframe.parts.registry import BACKEND, Registry


@dataclass(frozen=True, slots=True)
class Contender:
    """A back-end by name with its options; ``label`` is what tables and plots call it."""

    backend: str
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""

    @property
    def name(self) -> str:
        return self.label or self.backend


def parse_contenders(specs: Sequence[str], assignments: Sequence[str], installed: Registry) -> list[Contender]:
    """A contender for each of ``specs``, with every option checked and the defaults filled in.

    A spec is a name, or a name with options of its own: ``msckf:max_clones=15,max_slam_features=0``. ``assignments``,
    ``key=value`` texts, go to all that have such an option. Raises :class:`ConfigError` or :class:`PluginError`.
    """
    specs = list(dict.fromkeys(specs))
    named = [(name, own) for name, _, own in (spec.partition(":") for spec in specs)]
    known = {name: {option.name for option in installed.find(BACKEND, name).options} for name, _ in named}
    shared = [text.strip().removeprefix("backend.") for text in assignments]
    for text in shared:
        if not any(_key(text) in options for options in known.values()):
            _options(named[0][0], [text], installed)  # says what is wrong with it
            raise ConfigError(f"-o takes key=value, got {text!r}")
    return [
        Contender(
            name,
            _options(name, [t for t in shared if _key(t) in known[name]] + (own.split(",") if own else []), installed),
            spec,
        )
        for spec, (name, own) in zip(specs, named, strict=True)
    ]


def _options(name: str, assignments: Sequence[str], installed: Registry) -> dict[str, Any]:
    # Only back-ends: a detector's option, or the front-end's, would do nothing here.
    qualified = [f"backend.{text.strip()}" for text in assignments]
    config = configuration.override(Config(backend=PartConfig(name=name)), installed, qualified)
    return installed.find(BACKEND, name).validate(config.backend.options)


def _key(assignment: str) -> str:
    return assignment.partition("=")[0].strip()
