"""The options of a part: read from its factory's signature, shown with their help, checked and coerced.

A factory states its options once, as parameters with types and defaults. Where there are many, they are better kept
as the fields of a frozen dataclass; :func:`plugin_factory` makes a factory of it. Help comes from
``Annotated[int, "..."]`` or from the string that follows a dataclass field.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, wraps
from itertools import pairwise
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from vioframe.errors import ConfigError, shown

PartT = TypeVar("PartT")

REQUIRED = inspect.Parameter.empty
"""The default of an option that has none."""


@dataclass(frozen=True, slots=True)
class Option:
    """One option of a part. ``default`` is :data:`REQUIRED` where the option must be given."""

    name: str
    type: Any
    default: Any = REQUIRED
    doc: str = ""

    @property
    def type_name(self) -> str:
        plain = get_args(self.type)[0] if get_origin(self.type) is Annotated else self.type
        return inspect.formatannotation(plain)

    def __str__(self) -> str:
        default = "" if self.default is REQUIRED else f" = {self.default!r}"
        return f"{self.name}: {self.type_name}{default}"

    def coerce(self, value: Any) -> Any:
        """``value`` as this option's type; raises pydantic's ValidationError where it cannot be."""
        return TypeAdapter(self.type, config=ConfigDict(arbitrary_types_allowed=True)).validate_python(value)


def options_of(factory: Callable[..., Any], given: int = 0) -> list[Option]:
    """The options of ``factory``: its named parameters after the first ``given`` ones, which the framework fills in."""
    signature = inspect.signature(factory)
    owner = getattr(factory, "options_type", factory)
    docs = _attribute_docs(owner) if isinstance(owner, type) else {}
    named = [p for p in signature.parameters.values() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    options = []
    for parameter in named[given:]:
        annotation = _resolve(parameter.annotation, factory)
        doc = _annotated_doc(annotation) or docs.get(parameter.name, "")
        options.append(Option(parameter.name, annotation, parameter.default, doc))
    return options


def validate_options(
    owner: str, factory: Callable[..., Any], values: Mapping[str, Any], given: int = 0
) -> dict[str, Any]:
    """``values`` coerced to their types, the defaults filled in: everything that ``factory`` will be called with.

    Raises :class:`ConfigError`, showing the options there are, for an unknown, missing or unsuitable one.
    """
    table = {option.name: option for option in options_of(factory, given)}

    def offered() -> str:
        return f"its options: {', '.join(map(str, table.values()))}" if table else "it has no options"

    for name in values:
        if name not in table:
            raise ConfigError(f"{owner} has no option {shown(name)}{did_you_mean(name, table)}; {offered()}")
    complete = {}
    for name, option in table.items():
        if name not in values:
            if option.default is REQUIRED:
                meaning = f" ({option.doc})" if option.doc else ""
                raise ConfigError(f"{owner} needs the option {name!r}{meaning}: pass -o {name}=...; {offered()}")
            complete[name] = option.default
            continue
        try:
            complete[name] = option.coerce(values[name])
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise ConfigError(f"{owner}: {name}={shown(values[name])}: {reason}; {offered()}") from error
    options_type = getattr(factory, "options_type", None)
    if options_type is not None:
        try:
            options_type(**complete)  # what its __post_init__ has to say about the values together
        except ValueError as error:
            raise ConfigError(f"{owner}: {error}") from error
    return complete


def plugin_factory(build: Callable[..., PartT], options_type: type) -> Callable[..., PartT]:
    """A factory whose options are the fields of the dataclass ``options_type``.

    ``build`` takes what the framework gives (a loop closer: the calibration; a back-end: nothing), then the options as
    one object: ``plugin_factory(f, Options)(calibration, window=10)`` is ``f(calibration, Options(window=10))``.
    """
    positional = [p for p in inspect.signature(build).parameters.values() if p.kind is not p.KEYWORD_ONLY]
    fields = inspect.signature(options_type).parameters.values()

    @wraps(build)
    def factory(*given: Any, **options: Any) -> PartT:
        return build(*given, options_type(**options))

    vars(factory).update(
        __signature__=inspect.Signature([*positional[:-1], *(p.replace(kind=p.KEYWORD_ONLY) for p in fields)]),
        options_type=options_type,
    )
    return factory


def summary_of(factory: object) -> str:
    """The first paragraph of a part's docstring, in one line."""
    return " ".join((inspect.getdoc(factory) or "").partition("\n\n")[0].split())


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``" (did you mean 'orb'?)"``, or nothing where no known name is near."""
    near = get_close_matches(name, list(known), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _resolve(annotation: Any, factory: Callable[..., Any]) -> Any:
    """The type an annotation means; Any where there is none or its name exists for the type checker only."""
    if annotation is inspect.Parameter.empty:
        return Any
    if not isinstance(annotation, str):
        return annotation
    source = getattr(factory, "options_type", factory)
    function = source.__init__ if inspect.isclass(source) else inspect.unwrap(source)
    try:
        return eval(annotation, getattr(function, "__globals__", {}))
    except NameError:
        return Any


def _annotated_doc(annotation: Any) -> str:
    """The help in ``Annotated[T, "help"]`` or ``Annotated[T, Field(description="help")]``."""
    if get_origin(annotation) is Annotated:
        for note in annotation.__metadata__:
            text = note if isinstance(note, str) else getattr(note, "description", None)
            if text:
                return str(text)
    return ""


@cache
def _attribute_docs(owner: type) -> Mapping[str, str]:
    """The strings that follow the annotated attributes of a class, by attribute: Python itself does not keep them."""
    docs: dict[str, str] = {}
    for cls in reversed(owner.__mro__[:-1]):
        try:
            (definition,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        except (OSError, TypeError, SyntaxError):
            continue  # no source, as in an interactive session: no help
        body = definition.body if isinstance(definition, ast.ClassDef) else []
        for field, after in pairwise(body):
            match field, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    docs[name] = " ".join(text.split())
    return docs
