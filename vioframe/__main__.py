"""``python -m vioframe``."""

from vioframe.cli import main

main(prog_name="vioframe")
