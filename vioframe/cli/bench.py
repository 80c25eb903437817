"""``vioframe bench``: parts compared with one another, a sub-command a question."""

from __future__ import annotations

import click

from vioframe.cli.lazy import LazyGroup

_COMMANDS = {
    "detectors": "Detectors by speed, by quality, or by the tracks made of them.",
}


@click.group("bench", cls=LazyGroup, modules="vioframe.cli.bench_{}", summaries=_COMMANDS)
def command() -> None:
    """Compare parts with one another."""
