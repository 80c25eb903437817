"""The real command line, within this process or beside it."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from click.testing import CliRunner, Result

from vioframe.cli import main


def vioframe_(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], catch_exceptions=False)


def error_line(*arguments: object) -> str:
    """What a command that refuses says: one line, nothing else, exit code 2."""
    result = vioframe_(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("vioframe: error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr


def vioframe_process(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "vioframe", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)
