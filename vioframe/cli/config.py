"""``vioframe config``: a complete, commented configuration to start from, or a check of one."""

from __future__ import annotations

from pathlib import Path

import click

from vioframe.parts import config, registry
from vioframe.parts.config import Config, PartConfig


@click.command("config")
@click.option("--detector", help="Show this detector's options.")
@click.option("--backend", help="Show this back-end's options.")
@click.option("--check", "file", type=click.Path(path_type=Path), help="Check FILE instead: every key and value.")
def command(detector: str | None, backend: str | None, file: Path | None) -> None:
    """Print the complete default configuration with comments, or check a configuration file."""
    installed = registry.load()
    if file is not None:
        config.complete(config.read(file), installed)
        click.echo(f"{file} is valid")
        return
    chosen = {
        section: PartConfig(name=name) for section, name in (("detector", detector), ("backend", backend)) if name
    }
    click.echo(config.render(config.complete(Config().model_copy(update=chosen), installed), installed), nl=False)
