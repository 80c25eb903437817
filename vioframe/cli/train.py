"""``vioframe train``: what a learned part needs, from images; progress with losses, resumable."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from vioframe.cli.common import FILE, Bar, PartName, quiet_option
from vioframe.interfaces import Trainer
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.types import TrainingJob, TrainingStep


@click.command("train")
@click.argument("name", type=PartName("TRAINER"))
@click.option("--images", type=FILE, multiple=True, required=True, help="Folder of photographs, or recording; repeat.")
@click.option("--out", type=FILE, help="Folder for checkpoint, log and weights.  [default: training/NAME]")
@click.option("--hold-out", metavar="PATTERN", multiple=True, help="Images to validate on, by name; repeat.")
@click.option(
    "--finetune",
    "start_from",
    metavar="NAME|FILE",
    type=FILE,
    help="Weights to begin with: those that ship by their name, or a file.",
)
@click.option("--config", "config_file", type=FILE, help="YAML file of options; -o overrides it.")
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Set an option of the trainer.")
@click.option("--resume", is_flag=True, help="Go on with the training in --out.")
@quiet_option
def train(
    name: str,
    images: tuple[Path, ...],
    out: Path | None,
    hold_out: tuple[str, ...],
    start_from: Path | None,
    config_file: Path | None,
    options: tuple[str, ...],
    resume: bool,
    quiet: bool,
) -> None:
    """Train NAME, such as keypointnet, on photographs and on the images of recordings.

    An image is held out where its path contains PATTERN, or matches it as `*/V1_*` does. `vioframe plugins NAME` lists
    the options. Stopped by Ctrl-C, a training goes on with --resume as if nothing had been.
    """
    part = registry.load().find(registry.TRAINER, name)
    chosen = configuration.read_tree(config_file) if config_file else {}
    for _, option, value in configuration.parse_assignments(options, {"trainer": part.options}):
        chosen[option] = value
    job = TrainingJob(images, out or Path("training") / name, hold_out, start_from, resume)
    trainer: Trainer = part.create(job, options=chosen)
    step: TrainingStep | None = None
    with Bar(None, quiet=quiet) as bar:
        for step in trainer.train():
            bar(_figures(step.losses), advance=step.done - bar.completed, total=step.total)
            if step.epoch is not None:
                bar.progress.print(_figures(step.epoch))
    if not quiet:
        click.echo(f"{name}: {step.done if step else 0} steps; written to {job.out}")


def _figures(values: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in values.items())
