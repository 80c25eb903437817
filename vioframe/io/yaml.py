"""YAML from anybody as plain values; no file is so large, so deep or so full of aliases as to take the machine down."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from vioframe.errors import shortened

# Far beyond any configuration or calibration; the parser takes seconds for as much.
_MOST_CHARACTERS = 2**18
# Counted as often as aliases repeat them: a few lines of aliases of aliases stand for billions of values.
_MOST_VALUES = 50_000
_DEEPEST = 60
_MOST_BITS = 1024


def read_yaml_text(path: Path) -> str:
    """Raises :class:`OSError`, and :class:`ValueError` where the file is no text or too large to be meant."""
    with path.open(encoding="utf-8-sig") as file:
        try:
            text = file.read(_MOST_CHARACTERS + 1)
        except UnicodeDecodeError:
            raise ValueError("not a text file") from None
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(f"longer than {_MOST_CHARACTERS} characters; is it the right file?")
    return text


def parse_yaml(text: str) -> Any:
    """The value of a YAML document; raises :class:`ValueError` that says in one line what is wrong with it."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        tree = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise ValueError(shortened(error)) from None
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except MemoryError:
        raise
    # ruamel passes on whatever its constructors stumble on: a month 13, an integer of 5000 digits, a list for a key.
    except Exception as error:
        raise ValueError(shortened(error) or type(error).__name__) from None
    _check_extent(tree, _DEEPEST, _MOST_VALUES)
    return tree


def _check_extent(value: Any, depth: int, values: int) -> int:
    """How many of the ``values`` that are allowed are left behind ``value``."""
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:
        raise ValueError("it holds an integer of more than 300 digits")
    if not isinstance(value, Collection) or isinstance(value, str | bytes):
        return values - 1
    if depth == 0:
        raise ValueError("it is nested too deeply, or an alias holds itself")
    for item in [*value, *value.values()] if isinstance(value, Mapping) else value:
        values = _check_extent(item, depth - 1, values)
        if values < 0:
            raise ValueError(f"its aliases make more than {_MOST_VALUES} values of it; write it without them")
    return values
