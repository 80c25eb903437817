"""What a run is made of: YAML in, a frozen and validated :class:`Config` out; an unknown key is an error.

The options of the parts are checked against the signatures of the parts themselves, so that a plug-in's options need no
second description. :func:`complete` fills in every default: the configuration kept with a run says everything.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import to_jsonable_python
from ruamel.yaml import YAML

from vioframe.errors import ConfigError, shortened, shown
from vioframe.estimation.options import EstimationOptions
from vioframe.frontend import FrontendOptions
from vioframe.io.yaml import parse_yaml, read_yaml_text
from vioframe.parts.options import Option, did_you_mean, options_of, validate_options
from vioframe.parts.registry import BACKEND, DETECTOR, LOOP_CLOSER, Kind, Part, Registry

SectionT = TypeVar("SectionT", bound="Section")

PART_SECTIONS = {"detector": DETECTOR, "backend": BACKEND, "loop_closure": LOOP_CLOSER}
# What is not of one part, but of all that are put in its place.
OPTION_SECTIONS = {"frontend": FrontendOptions, "estimation": EstimationOptions}


class Section(BaseModel):
    """A part of a configuration: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class DatasetConfig(Section):
    """What to read."""

    path: Path | None = Field(default=None, description="bag or folder to read")
    reader: str | None = Field(default=None, description="null: the one that accepts the path")
    options: dict[str, Any] = {}


class Named(Section):
    """Something with a name; a bare name is enough."""

    name: str

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @property
    def called(self) -> str:
        """What tables and plots call it."""
        return self.name


class PartConfig(Named):
    """A part by name, and its options."""

    options: dict[str, Any] = {}


class LabelledPart(PartConfig):
    """A part that is compared with others, maybe with itself under other options, to be called ``label``."""

    label: str = ""

    @property
    def called(self) -> str:
        return self.label or self.name


class Config(Section):
    """Everything that determines a run."""

    dataset: DatasetConfig = DatasetConfig()
    detector: PartConfig = PartConfig(name="shi_tomasi")
    backend: PartConfig = PartConfig(name="msckf")
    loop_closure: PartConfig | None = Field(default=None, description="loop closer (name, options); null: none")
    frontend: dict[str, Any] = {}
    estimation: dict[str, Any] = {}
    wait_ms: float = Field(
        default=50.0, ge=0.0, allow_inf_nan=False, description="how long a frame waits for readings that come late"
    )
    ground_truth: Path | None = Field(default=None, description="trajectory file (TUM, or EuRoC csv) to compare with")
    start_s: float = Field(default=0.0, ge=0.0, allow_inf_nan=False, description="seconds skipped at the start")
    duration_s: float | None = Field(default=None, gt=0.0, allow_inf_nan=False, description="null: run to the end")

    @property
    def frontend_options(self) -> FrontendOptions:
        return FrontendOptions(**validate_options("the front-end", FrontendOptions, self.frontend))

    @property
    def estimation_options(self) -> EstimationOptions:
        return EstimationOptions(**validate_options("the estimation", EstimationOptions, self.estimation))


def read(path: str | Path) -> Config:
    """Read a configuration file; raises :class:`ConfigError` naming the key that is wrong."""
    return parse(read_tree(path), str(path))


def read_tree(path: str | Path) -> dict[str, Any]:
    """The keys and values of a YAML file; raises :class:`ConfigError` where it holds none."""
    try:
        text = read_yaml_text(Path(path))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"cannot read the configuration {path}: {reason}") from error
    try:
        tree = parse_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(tree, dict | None):
        raise ConfigError(f"{path} must hold keys and values; `vioframe config` prints an example")
    return tree or {}


def parse(tree: Mapping[str, Any], origin: str = "configuration") -> Config:
    """Validate a tree of plain values; ``origin`` names it in errors."""
    return validate(Config, tree, origin)


def validate(model: type[SectionT], tree: Mapping[str, Any], origin: str) -> SectionT:
    """``tree`` as a ``model``; raises :class:`ConfigError` naming the key that is wrong, and ``origin``."""
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        # A misspelt key first: what is missing because of it is found when that is put right.
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        where = shortened(".".join(map(str, first["loc"])))
        if first["type"] == "extra_forbidden":
            known = _keys_beside(model, first["loc"])
            hint = did_you_mean(str(first["loc"][-1]), known)
            raise ConfigError(f"{origin}: unknown key {where!r}{hint}; keys here: {', '.join(known)}") from error
        problem = first["msg"].removeprefix("Value error, ")
        if not first["loc"]:  # values that do not go together
            raise ConfigError(f"{origin}: {problem}") from error
        raise ConfigError(f"{origin}: {where}: {problem}, got {shown(first['input'])}") from error


def to_yaml(section: Section) -> str:
    """``section`` as YAML without comments, its keys in the order of their definition."""
    yaml, stream = YAML(typ="safe", pure=True), StringIO()
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = False, 110, False  # type: ignore[assignment]
    yaml.dump(to_jsonable_python(section.model_dump()), stream)
    return stream.getvalue()


def override(config: Config, registry: Registry, assignments: Iterable[str]) -> Config:
    """``config`` with options set from ``key=value`` texts, as the command line's ``-o`` gives them.

    A key is qualified (``backend.max_clones``) or bare, which goes to the one part that has such an option.
    """
    options = _options_by_section(config, registry)
    tree = config.model_dump()
    for section, name, value in parse_assignments(assignments, options):
        values = tree[section] if section in OPTION_SECTIONS else tree[section]["options"]
        values[name] = value
    return parse(tree)


def parse_assignments(
    assignments: Iterable[str], options: Mapping[str, list[Option]]
) -> Iterator[tuple[str, str, Any]]:
    """Section, option and value of each ``key=value``, for the ``options`` by section; see :func:`override`."""
    for assignment in assignments:
        key, text = _split(assignment, "-o takes key=value")
        section, option = _find_option(key, options)
        yield section, option.name, _parse_value(option, text)


def _split(assignment: str, rule: str) -> tuple[str, str]:
    key, equals, text = (word.strip() for word in assignment.partition("="))
    if not key or not equals:
        raise ConfigError(f"{rule}, got {assignment!r}")
    return key, text


def parse_part(spec: str, kind: Kind, registry: Registry) -> PartConfig:
    """The part that ``NAME`` or ``NAME:KEY=VALUE,...`` asks for; a value may be a list, as in ``lengths_m=[8,16]``.

    Raises :class:`PluginError` where there is no such part; its options are checked where it is created.
    """
    name, _, own = spec.partition(":")
    known = {option.name: option for option in registry.find(kind, name).options}
    options: dict[str, Any] = {}
    # Commas within brackets belong to a value.
    for assignment in re.split(r",(?![^\[]*\])", own) if own else []:
        key, text = _split(assignment, f"{spec!r}: options are given as {name}:KEY=VALUE,...")
        options[key] = _parse_value(known[key], text) if key in known else text
    return PartConfig(name=name, options=options)


def complete(config: Config, registry: Registry) -> Config:
    """``config`` with every option of every part checked, coerced and its default filled in."""
    changes: dict[str, Any] = {
        "frontend": asdict(config.frontend_options),
        "estimation": asdict(config.estimation_options),
        "ground_truth": config.ground_truth and config.ground_truth.absolute(),
    }
    for section, part in _parts_by_section(config, registry).items():
        named = getattr(config, section)
        found = {}
        if section == "dataset":
            _, given = registry.resolve(named.path, named.reader)
            found = {"path": given.absolute() if isinstance(given, Path) else named.path, "reader": part.name}
        changes[section] = named.model_copy(update={"options": part.validate(named.options), **found})
    return config.model_copy(update=changes)


def render(config: Config, registry: Registry) -> str:
    """``config`` as YAML, each option with its help as a comment; :func:`read` returns the same configuration."""
    docs = {name: field.description or "" for name, field in Config.model_fields.items()}
    docs |= {f"dataset.{name}": field.description or "" for name, field in DatasetConfig.model_fields.items()}
    for section, options in _options_by_section(config, registry).items():
        where = section if section in OPTION_SECTIONS else f"{section}.options"
        docs |= {f"{where}.{option.name}": option.doc for option in options}
    lines = ["# A vioframe configuration: use it with `vioframe run --config FILE`."]
    return "\n".join([*lines, *_commented(config.model_dump(), docs)]) + "\n"


def _commented(tree: Mapping[str, Any], docs: Mapping[str, str], within: str = "") -> Iterator[str]:
    """Lines of YAML, each value below its help in ``docs``, which go by keys such as ``backend.options.max_clones``."""
    indent = "  " * within.count(".")
    for name, value in tree.items():
        key = f"{within}{name}"
        if isinstance(value, dict) and value:
            yield f"{indent}{name}:"
            yield from _commented(value, docs, f"{key}.")
        else:
            comment = f"{indent}# "
            yield from textwrap.wrap(docs.get(key, ""), 110, initial_indent=comment, subsequent_indent=comment)
            yield f"{indent}{name}: {_scalar(value)}"


def _parts_by_section(config: Config, registry: Registry) -> dict[str, Part]:
    """The parts that ``config`` names; a section that names none has none."""
    named = {section: (kind, getattr(config, section)) for section, kind in PART_SECTIONS.items()}
    parts = {section: registry.find(kind, part.name) for section, (kind, part) in named.items() if part is not None}
    if config.dataset.path is not None:
        parts["dataset"], _ = registry.resolve(config.dataset.path, config.dataset.reader)
    return parts


def _options_by_section(config: Config, registry: Registry) -> dict[str, list[Option]]:
    of_parts = {section: part.options for section, part in _parts_by_section(config, registry).items()}
    return of_parts | {section: options_of(factory) for section, factory in OPTION_SECTIONS.items()}


def _find_option(key: str, sections: Mapping[str, list[Option]]) -> tuple[str, Option]:
    """The section and the option that ``key`` means; raises :class:`ConfigError` where it is none or several."""
    every = {
        f"{section}.{option.name}": (section, option) for section, options in sections.items() for option in options
    }
    if key in every:
        return every[key]
    matches = [full for full, (_, option) in every.items() if option.name == key]
    if len(matches) == 1:
        return every[matches[0]]
    if matches:
        raise ConfigError(f"-o {key} is ambiguous: write one of {', '.join(matches)}")
    section, dot, _ = key.partition(".")
    if dot and section not in sections:
        hint = did_you_mean(section, sections)
        raise ConfigError(f"-o {key}: there is no section {section!r}{hint}; sections: {', '.join(sections)}")
    candidates = every if dot else {option.name for _, option in every.values()}
    hint = did_you_mean(key, candidates) or f"; options: {', '.join(every)}"
    raise ConfigError(f"-o {key}: no part has such an option{hint}")


def _parse_value(option: Option, text: str) -> Any:
    """``text`` as YAML where that suits the option (numbers, null, lists), else as it is.

    Where neither suits it is as YAML, which says better what is wrong with it.
    """
    try:
        parsed = parse_yaml(text)
    except ValueError:
        return text
    for value in (parsed, text):
        try:
            option.coerce(value)
        except ValidationError:
            continue
        return value
    return parsed


def _keys_beside(model: Any, location: tuple[int | str, ...]) -> list[str]:
    for key in location[:-1]:
        if key in model.model_fields:  # else it is a place in a list or table of the model
            found = model.model_fields[key].annotation
            model = next((each for each in (found, *get_args(found)) if hasattr(each, "model_fields")), model)
    return list(model.model_fields)


def _scalar(value: Any) -> str:
    yaml, stream = YAML(typ="safe", pure=True), StringIO()
    yaml.default_flow_style, yaml.width = True, 100_000
    yaml.dump(to_jsonable_python(value), stream)
    return stream.getvalue().removesuffix("...\n").strip()
