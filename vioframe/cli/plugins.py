"""``vioframe plugins``: what is installed, what failed to load, and the options of a part."""

from __future__ import annotations

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vioframe.errors import PluginError
from vioframe.parts import registry
from vioframe.parts.options import REQUIRED, did_you_mean, summary_of


@click.command("plugins")
@click.argument("name", required=False)
def command(name: str | None) -> None:
    """List every part: detectors, back-ends, loop closers, data-set readers, flights, worlds, metrics and trainers.

    With NAME, show the options of that part.
    """
    installed = registry.load()
    console = Console()
    if name is None:
        _list(console, installed)
        return
    parts = [table[name] for table in installed.parts.values() if name in table]
    if not parts:
        known = sorted({known for table in installed.parts.values() for known in table})
        raise PluginError(f"no part is called {name!r}{did_you_mean(name, known)}; installed: {', '.join(known)}")
    for part in parts:
        _show(console, part)


def _list(console: Console, installed: registry.Registry) -> None:
    table = _table("kind", "name", "distribution", "version", "what it is")
    for kind in registry.KINDS:
        for name in installed.names(kind):
            part = installed.find(kind, name)
            table.add_row(
                kind.name, name, part.source.distribution, part.source.version, Text(summary_of(part.factory))
            )
    console.print(table)
    if installed.failures:
        failed = _table("failed to load", "distribution", "version", "why")
        for failure in installed.failures:
            source = failure.source
            failed.add_row(source.entry_point, source.distribution, source.version, Text(failure.reason))
        console.print(failed)


def _show(console: Console, part: registry.Part) -> None:
    console.print(Text(f"{part}: {summary_of(part.factory)}"))
    if not part.options:
        console.print("It has no options.")
        return
    table = _table("option", "type", "default", "meaning")
    for option in part.options:
        default = "required" if option.default is REQUIRED else repr(option.default)
        table.add_row(option.name, Text(option.type_name), Text(default), Text(option.doc))
    console.print(table)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table
