"""Writes docs/cli.md from the program itself: `python docs/make_cli_reference.py`. A test holds the two equal."""

import inspect
import re
from pathlib import Path

import click
from click.testing import CliRunner

from vioframe.cli import main
from vioframe.parts import registry
from vioframe.parts.config import OPTION_SECTIONS
from vioframe.parts.options import REQUIRED, Option, options_of

PAGE = Path(__file__).parent / "cli.md"

_HEAD = """\
# Command line and options

<!-- Written by docs/make_cli_reference.py; change the help texts in the code and run it again. -->

Bad input ends with one line on stderr and exit code 2, Ctrl-C with 130, SIGTERM with 143; `--debug` shows a traceback.
A `run` that never initialised and a `check` that found something wrong end with 1.

The shell completes commands, options and the names of parts with this line in its start-up file (or with `zsh_source`):
`eval "$(_VIOFRAME_COMPLETE=bash_source vioframe)"`.
"""
_PARTS = """\
## Options of the parts

What `-o NAME=VALUE` sets; write `-o SECTION.NAME=VALUE`, with the section `detector`, `backend`, `loop_closure`,
`dataset`, `frontend` or `estimation`, where several parts have such an option. `vioframe plugins NAME` prints the same
for every installed part, yours included.
"""


def page() -> str:
    """The whole of docs/cli.md."""
    shared = [_section(name, _summary(of), options_of(of)) for name, of in OPTION_SECTIONS.items()]
    return "\n".join([_HEAD, *_commands(), _PARTS, *_parts(), *shared])


def _commands() -> list[str]:
    context = click.Context(main)
    names = main.list_commands(context)
    return [_help(), *(section for name in names for section in _sections(name, main.get_command(context, name)))]


def _sections(name: str, command: click.Command | None) -> list[str]:
    within = command.list_commands(click.Context(command)) if isinstance(command, click.Group) else []
    return [_help(name), *(_help(name, sub) for sub in within)]


def _help(*command: str) -> str:
    shown = CliRunner().invoke(main, [*command, "--help"], prog_name="vioframe", terminal_width=100)
    title = " ".join(["vioframe", *command])
    return f"## {title}\n\n```\n{shown.output.rstrip()}\n```\n"


def _parts() -> list[str]:
    """A section for each part that comes with vioframe."""
    installed = registry.load()
    own = [
        (kind, part)
        for kind in registry.KINDS
        for name in installed.names(kind)
        if (part := installed.find(kind, name)).origin.distribution == "vioframe"
    ]
    return [_section(f"{kind.name} `{part.name}`", _summary(part.factory), part.options) for kind, part in own]


def _summary(factory: object) -> str:
    return " ".join((inspect.getdoc(factory) or "").partition("\n\n")[0].split())


def _section(title: str, summary: str, options: list[Option]) -> str:
    lines = [f"### {title}", ""]
    if summary:
        lines += [summary, ""]
    if not options:
        return "\n".join([*lines, "No options.", ""])
    rows = [[f"`{o.name}`", f"`{_type(o)}`", _default(o), o.doc] for o in options]
    lines += ["| option | type | default | meaning |", "|---|---|---|---|"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([*lines, ""])


def _type(option: Option) -> str:
    return re.sub(r"pathlib\.(_local\.)?", "", option.type_name)  # Python 3.13 moved Path


def _default(option: Option) -> str:
    return "required" if option.default is REQUIRED else f"`{option.default!r}`"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
