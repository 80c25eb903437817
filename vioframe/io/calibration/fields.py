"""YAML files as checked fields, so that every mistake is reported with the file and the key it is in."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from vioframe.errors import CalibrationError
from vioframe.types import Float

# OpenCV's dialect: a "%YAML:1.0" directive and "!!opencv-matrix" tags, neither of which is YAML.
_OPENCV_DIALECT = re.compile(r"^%YAML.*$|!!opencv-[\w-]+", re.MULTILINE)


def read_yaml(path: Path) -> Fields:
    """The top level of a YAML file, OpenCV's dialect included."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not a text file"
        raise CalibrationError(f"cannot read the calibration {path}: {reason}") from None
    try:
        values = YAML(typ="safe", pure=True).load(_OPENCV_DIALECT.sub("", text))
    except YAMLError as err:
        raise CalibrationError(f"{path} is not valid YAML: {' '.join(str(err).split())}") from None
    if not isinstance(values, Mapping):
        raise CalibrationError(f"{path} holds no calibration: expected 'key: value' lines")
    return Fields(values, str(path))


class Fields:
    """A YAML mapping whose getters check type and size; ``where`` names it in error messages."""

    def __init__(self, values: Mapping[str, object], where: str) -> None:
        self._values = values
        self.where = where

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return (str(key) for key in self._values)

    def fail(self, problem: str) -> CalibrationError:
        """The error to raise for ``problem`` in this mapping."""
        return CalibrationError(f"{self.where}: {problem}")

    def get(self, key: str) -> object:
        """The value of ``key``, whatever it is."""
        if key not in self._values:
            raise self.fail(f"{key!r} is missing")
        return self._values[key]

    def section(self, key: str) -> Fields:
        """The nested mapping under ``key``."""
        value = self.get(key)
        if not isinstance(value, Mapping):
            raise self.fail(f"{key!r} should hold a mapping, not {value!r}")
        return Fields(value, f"{self.where} [{key}]")

    def text(self, key: str, default: str | None = None) -> str:
        """The value of ``key`` as text."""
        return str(self.get(key)) if default is None or key in self._values else default

    def number(self, key: str, default: float | None = None) -> float:
        """The value of ``key``, one finite number."""
        if default is not None and key not in self._values:
            return default
        return float(self._array(key, self.get(key), (1,))[0])

    def numbers(self, key: str, *counts: int) -> Float:
        """The value of ``key``, (N,), a list of numbers with N one of ``counts``."""
        return self._array(key, self.get(key), counts)

    def matrix(self, key: str, rows: int, cols: int) -> Float:
        """The value of ``key``, (rows, cols), as a list of rows or as OpenCV's and EuRoC's ``rows, cols, data``."""
        value = self.get(key)
        if isinstance(value, Mapping):
            value = self.section(key).get("data")
        return self._array(key, value, (rows * cols,)).reshape(rows, cols)

    def _array(self, key: str, value: object, counts: tuple[int, ...]) -> Float:
        expected = " or ".join(map(str, counts))
        try:
            array = np.asarray(value, dtype=np.float64).ravel()
        except (TypeError, ValueError):
            raise self.fail(f"{key!r} should be {expected} numbers, not {value!r}") from None
        if array.size not in counts or not np.isfinite(array).all():
            raise self.fail(f"{key!r} should be {expected} finite numbers, not {value!r}")
        return array
