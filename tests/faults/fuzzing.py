"""Files mutated at random: whatever is in them, it gives a result or a :class:`VioframeError`, soon and in bounds."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from vioframe.errors import VioframeError

MOST_S = 10.0
"""Longer than that is a hang; a good file takes milliseconds."""
MOST_BYTES = 300 * 2**20
"""What an example may touch of memory; a good file takes a hundredth."""


def budgets(quick: int, thorough: int) -> pytest.MarkDecorator:
    """Parametrises ``examples``: so many in every run of the suite, and so many where there is time."""
    return pytest.mark.parametrize("examples", [quick, pytest.param(thorough, marks=pytest.mark.very_slow)])


def fuzz(examples: int, strategy: st.SearchStrategy[Any], use: Callable[[Any], object]) -> None:
    """``use`` what ``strategy`` makes, the same ``examples`` in every run; a :class:`VioframeError` is in order."""

    @settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
    )
    @given(strategy)
    def check(made: Any) -> None:
        with bounded():
            try:
                use(made)
            except VioframeError as error:
                text = str(error)
                assert text.strip(), "an error without a word"
                assert len(text) < 2000, f"an error of {len(text)} characters"

    check()


class HangError(BaseException):
    """Nothing may catch it on its way."""


@contextmanager
def bounded() -> Iterator[None]:
    """Within it time and memory are short.

    Memory is asked for in vain where a length is damaged, and that is no harm: what counts is what is filled.
    """

    def stop(*_: object) -> None:
        raise HangError(f"not done in {MOST_S:g} s")

    limits = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, stop)
    Path("/proc/self/clear_refs").write_text("5")  # the peak of what is resident counts from now
    resident = memory("VmRSS")
    signal.setitimer(signal.ITIMER_REAL, MOST_S)
    resource.setrlimit(resource.RLIMIT_AS, (memory("VmSize") + 8 * MOST_BYTES, limits[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGALRM, before)
    filled = memory("VmHWM") - resident
    assert filled < MOST_BYTES, f"it filled {filled >> 20} MiB"


def memory(name: str) -> int:
    """A figure of this process in bytes, as proc(5) has it."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{name}:"))
    return 1024 * int(line.split()[1])


# What is written over numbers in binary files: lengths and places that lead far away, in bytes of either end.
_EXTREMES = [
    value.to_bytes(size, "little")
    for size, values in {4: (0, 1, 2**31 - 1, 2**31, 2**32 - 1), 8: (0, 2**40, 2**63 - 1, 2**63, 2**64 - 1)}.items()
    for value in values
]


def damaged(good: bytes) -> st.SearchStrategy[bytes]:
    """``good`` with up to four of: bytes changed, numbers made extreme, parts cut out, doubled, or put in."""
    place = st.integers(0, max(0, len(good) - 1))
    change = st.one_of(
        st.tuples(st.just("over"), place, st.binary(min_size=1, max_size=4)),
        st.tuples(st.just("over"), place, st.sampled_from(_EXTREMES)),
        st.tuples(st.just("end"), place, st.just(b"")),
        st.tuples(st.just("out"), place, st.integers(1, 200)),
        st.tuples(st.just("twice"), place, st.integers(1, 200)),
        st.tuples(st.just("in"), place, st.binary(min_size=1, max_size=20)),
    )

    def apply(changes: list[tuple[str, int, Any]]) -> bytes:
        data = bytearray(good)
        for kind, at, what in changes:
            if kind == "over":
                data[at : at + len(what)] = what
            elif kind == "end":
                del data[at:]
            elif kind == "out":
                del data[at : at + what]
            elif kind == "twice":
                data[at:at] = data[at : at + what]
            else:
                data[at:at] = what
        return bytes(data)

    return st.lists(change, min_size=1, max_size=4).map(apply)


_NESTED: Any = 1
for _ in range(40):
    _NESTED = [_NESTED]

# Values that are not what a key of a configuration or calibration wants.
ODD_VALUES: list[Any] = [
    *(None, True, False, "", "none", "../../x", "x" * 5000, "\0", "1e400", "é\u202e", "2001-13-45", b"\xff"),
    *(0, -1, 1, 3, 10**9, 10**18, 10**30, 10**400, -(10**400), 0.5, 1e-320, 1e30, 1e308, -1e308),
    *(float("nan"), float("inf"), float("-inf")),
    *([], {}, [None], [[]], {"data": 1}, {"data": []}, {"data": {"data": {}}}, {"": ""}, {1: 2}, {None: None}),
    *([0.0] * 3, [0.0] * 4, [1.0] * 9, [0.0] * 16, [float("nan")] * 16, ["a"] * 4, [10**400] * 4, [[1, 2], [3]]),
    *([1e200] * 16, [0, 0], [-752, 480], [1e9, 1e9], [0.0] * 5000, _NESTED, [{"name": "a"}], [{"name": 1}], [["a"]]),
]


def misshapen(tree: Any) -> st.SearchStrategy[Any]:
    """``tree`` with up to three of its keys or items gone, renamed, or of another value."""
    paths = list(_paths(tree))
    change = st.tuples(
        st.sampled_from(paths),
        st.one_of(
            st.just(("drop", None)),
            st.sampled_from(ODD_VALUES).map(lambda value: ("set", value)),
            st.sampled_from(["x", "", "cam1", "imu0", "data", 7, None]).map(lambda name: ("rename", name)),
            st.sampled_from(paths).map(lambda other: ("copy", other)),
        ),
    )
    return st.lists(change, min_size=1, max_size=3).map(lambda changes: _changed(tree, changes))


def _paths(tree: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where in ``tree`` there is something, its root left out."""
    for key, value in _items(tree):
        yield (*above, key)
        yield from _paths(value, (*above, key))


def _items(tree: Any) -> list[tuple[Any, Any]]:
    return list(tree.items()) if isinstance(tree, dict) else list(enumerate(tree)) if isinstance(tree, list) else []


def _changed(tree: Any, changes: list[tuple[tuple[Any, ...], tuple[str, Any]]]) -> Any:
    from copy import deepcopy

    root = deepcopy(tree)
    for path, (kind, value) in changes:
        try:
            node = root
            for key in path[:-1]:
                node = node[key]
            if kind == "drop":
                del node[path[-1]]
            elif kind == "rename" and isinstance(node, dict):
                node[value] = node.pop(path[-1])
            elif kind == "set":
                node[path[-1]] = value
            elif kind == "copy":
                found = tree
                for key in value:
                    found = found[key]
                node[path[-1]] = deepcopy(found)
        except (KeyError, IndexError, TypeError):
            continue  # what it was about has gone with an earlier change
    return root


def written(tree: Any) -> str:
    """``tree`` as YAML, numbers that JSON has no word for included."""
    from io import StringIO

    from ruamel.yaml import YAML

    yaml, stream = YAML(typ="safe", pure=True), StringIO()
    yaml.width = 10**6
    yaml.dump(tree, stream)
    return stream.getvalue()


_LAUGH = "\n".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10))
LAUGHS = f"a0: &a0 [1, 2, 3]\n{_LAUGH}\n"
"""A billion values out of a few lines: what is an ``a9`` there is more than any memory holds."""
YAML_BOMBS = {
    "laughs": LAUGHS + "KEY: *a9\n",
    "laughs as a mapping": LAUGHS + "KEY: {data: *a9}\n",
    "in itself": "KEY: &a [*a, *a]\n",
    "mapping in itself": "KEY: &a {data: *a}\n",
    "deep": "KEY: " + "[" * 500 + "]" * 500 + "\n",
    "deep blocks": "KEY:\n" + "".join(" " * k + "- \n" for k in range(1, 400)),
    "deep flow, open": "KEY: " + "[" * 500,
    "merged": "b: &b {x: 1}\nKEY: {<<: *b, <<: *b}\n",
    "no date": "KEY: 2001-99-99\n",
    "number of many digits": f"KEY: {'9' * 5000}\n",
    "base 60": f"KEY: {':'.join(['59'] * 500)}\n",
    "long": "KEY: [" + "0," * 600_000 + "0]\n",
    "binary": "KEY: !!binary '=='\n",
    "python": "KEY: !!python/object/apply:os.system ['true']\n",
    "set": "KEY: !!set {a, b}\n",
    "ordered": "KEY: !!omap [a: 1]\n",
    "list as a key": "? [KEY]\n: 1\n",
    "mapping as a key": "? {KEY: 1}\n: 1\n",
    "two documents": "KEY: 1\n---\nKEY: 2\n",
    "control characters": "KEY: \x07\n",
    "tabs": "KEY:\n\t- 1\n",
}
"""Text whose ``KEY`` is to be replaced by one that matters."""
