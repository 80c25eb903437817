"""The command line: sub-commands in small modules, imported only when one is called."""

from __future__ import annotations

import errno
import logging
import re
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import click

import vioframe
from vioframe.errors import VioframeError

_COMMANDS = {
    "run": "Estimate the motion along a recording and write a run folder.",
    "check": "Say what is wrong with a recording, or with a plug-in.",
    "evaluate": "Compare runs with the ground truth, as a table.",
    "plot": "Draw trajectories and errors of one or more runs.",
    "view": "Show runs in space and over time, in rerun's viewer.",
    "plugins": "List the detectors, back-ends and readers, or the options of one.",
    "config": "Print a complete configuration, or check a file.",
    "simulate": "Render a flight and write it as a recording with exact truth.",
    "montecarlo": "Fly many simulated flights: accuracy and consistency of back-ends.",
    "bench": "Compare parts: detectors, or a suite of whatever you like.",
    "report": "Tables, figures and a page of what `vioframe bench SUITE` found.",
    "train": "Train what a learned part needs, such as keypointnet.",
    "convert": "Convert a recording: ASL folder, ROS 1 bag, ROS 2 bag, MCAP.",
}
"""Sub-commands and their short help, kept here so that ``vioframe --help`` needs none of their modules."""

_MODULES = {
    **dict.fromkeys(("evaluate", "plot", "view", "report"), "show"),
    **dict.fromkeys(("plugins", "config"), "parts"),
    **dict.fromkeys(("simulate", "convert"), "recordings"),
}

EXIT_FAILED = 1
"""What was asked for was done, and came to nothing, or found something wrong."""
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


class LazyGroup(click.Group):
    """A group whose sub-commands, ``summaries`` with their short help by name, are imported only when they are called.

    ``modules`` of this package hold them under their own names; one that is not listed is in a module of its own.
    """

    def __init__(self, *args: Any, modules: Mapping[str, str], summaries: Mapping[str, str], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._modules, self._summaries = modules, summaries

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._summaries)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in self._summaries:
            return None
        command: click.Command = getattr(import_module(f"vioframe.cli.{self._modules.get(name, name)}"), name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            from vioframe.parts.options import did_you_mean

            hint = did_you_mean(args[0], self._summaries)
            raise click.UsageError(f"{error.message.removesuffix('.')}{hint}", error.ctx) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(self._summaries.items()))


class _Terminated(KeyboardInterrupt):
    """A batch system or container asks to end: what is under way is completed as after Ctrl-C."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Within it SIGTERM raises :class:`_Terminated`; only the main thread of a process can see to that."""

    def end(*_: object) -> None:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class _Main(LazyGroup):
    """Turns errors into one line and an exit code."""

    def invoke(self, ctx: click.Context) -> object:
        try:
            with _terminable():
                return super().invoke(ctx)
        except VioframeError as error:
            if ctx.params["debug"]:
                raise
            _say(f"error: {self._in_options(ctx, str(error))}", error)
            ctx.exit(EXIT_BAD_INPUT)
        except OSError as error:
            # A reader that closed its end of the pipe, as `head` does, has all it wants: click ends quietly.
            if error.errno == errno.EPIPE or ctx.params["debug"]:
                raise
            what = f"{error.filename or 'the output'}: {error.strerror or error}"
            _say(f"error: cannot read or write {what}; check permissions and free space", error)
            ctx.exit(EXIT_BAD_INPUT)
        except MemoryError as error:
            if ctx.params["debug"]:
                raise
            _say("error: out of memory; give it less at a time, or a larger machine", error)
            ctx.exit(EXIT_BAD_INPUT)
        except _Terminated as error:
            _say("terminated", error)
            ctx.exit(EXIT_TERMINATED)
        except KeyboardInterrupt as error:
            _say("interrupted", error)
            ctx.exit(EXIT_INTERRUPTED)

    def _in_options(self, ctx: click.Context, message: str) -> str:
        """A key of the configuration that an option has set is called by the option: ``start_s`` by ``--start``."""
        command = self.get_command(ctx, ctx.invoked_subcommand or "")
        set_by = {each.name: each.opts[-1] for each in command.params} if command else {}

        def option(match: re.Match[str]) -> str:
            return set_by.get(match[1], match[0].removesuffix(":")) + ":"

        return re.sub(r"^command line: (?:\w+\.)*(\w+):", option, message).replace("command line: --", "--", 1)


def _say(text: str, error: BaseException) -> None:
    """One line on stderr: ``text`` and the notes that the error gathered on its way."""
    line = "; ".join([text, *getattr(error, "__notes__", [])])
    click.echo(f"vioframe: {' '.join(line.split())}", err=True)


class _EchoHandler(logging.Handler):
    """Log records on stderr as it is now: a progress bar, or a test, may have replaced it since the start."""

    def emit(self, record: logging.LogRecord) -> None:
        click.echo(f"vioframe: {record.levelname.lower()}: {self.format(record)}", err=True)


@click.group(cls=_Main, modules=_MODULES, summaries=_COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(vioframe.__version__, prog_name="vioframe")
@click.option("--debug", is_flag=True, envvar="VIOFRAME_DEBUG", help="Show the traceback of an error.")
def main(debug: bool) -> None:
    """Plug-in visual-inertial odometry: EuRoC bag in, evaluated trajectory out."""
    logger = logging.getLogger("vioframe")
    if not logger.handlers:
        logger.addHandler(_EchoHandler())
