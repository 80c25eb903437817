"""``vioframe plugins`` lists what is installed, ``config`` prints or checks a configuration made of it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vioframe.cli.common import FILE, PartName, print_notes
from vioframe.errors import PluginError
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, PartConfig
from vioframe.parts.options import REQUIRED, did_you_mean, summary_of


@click.command("plugins")
@click.argument("name", required=False, type=PartName())
def plugins(name: str | None) -> None:
    """List every part: detectors, back-ends, loop closers, data-set readers, flights, worlds, metrics and trainers.

    With NAME, show the options of that part.
    """
    installed = registry.load()
    every = [(kind, installed.find(kind, known)) for kind in registry.KINDS for known in installed.names(kind)]
    console = Console()
    if name is None:
        rows = [
            (kind.name, part.name, part.origin.distribution, part.origin.version, summary_of(part.factory))
            for kind, part in every
        ]
        console.print(_table(("kind", "name", "distribution", "version", "what it is"), rows))
        if installed.failures:
            failed = [
                (each.origin.entry_point, each.origin.distribution, each.origin.version, each.reason)
                for each in installed.failures
            ]
            console.print(_table(("failed to load", "distribution", "version", "why"), failed))
        print_notes(map(str, installed.clashes))
        return
    parts = [part for _, part in every if name in (part.name, part.name.partition("@")[0])]
    if not parts:
        known = sorted({part.name for _, part in every})
        raise PluginError(f"no part is called {name!r}{did_you_mean(name, known)}; installed: {', '.join(known)}")
    for part in parts:
        console.print(Text(f"{part}: {summary_of(part.factory)}"))
        if not part.options:
            console.print("It has no options.")
            continue
        defaults = ["required" if option.default is REQUIRED else repr(option.default) for option in part.options]
        meant = [(o.name, o.type_name, default, o.doc) for o, default in zip(part.options, defaults, strict=True)]
        console.print(_table(("option", "type", "default", "meaning"), meant))


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    return table


@click.command("config")
@click.option("--detector", type=PartName("DETECTOR"), help="Show this detector's options.")
@click.option("--backend", type=PartName("BACKEND"), help="Show this back-end's options.")
@click.option("--check", "file", type=FILE, help="Check FILE instead: every key and value.")
def config(file: Path | None, **parts: str | None) -> None:
    """Print the complete default configuration with comments, or check a configuration file."""
    installed = registry.load()
    if file is not None:
        configuration.complete(configuration.read(file), installed)
        click.echo(f"{file} is valid")
        return
    chosen = Config().model_copy(update={kind: PartConfig(name=name) for kind, name in parts.items() if name})
    click.echo(configuration.render(configuration.complete(chosen, installed), installed), nl=False)
