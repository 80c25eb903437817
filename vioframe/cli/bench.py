"""``vioframe bench``: parts compared with one another, a sub-command a question; every suite is one as well."""

from __future__ import annotations

import click

from vioframe.cli.lazy import LazyGroup

_COMMANDS = {
    "detectors": "Detectors by speed, by quality, or by the tracks made of them.",
    "detector_fps": "Suite: frames a second of all detectors.",
    "mh05_comparison": "Suite: KeypointNet and Shi-Tomasi on MH_05_difficult.",
    "euroc": "Suite: all eleven sequences, beside what is published.",
    "stress": "Suite: detectors and back-ends under hard conditions.",
    "consistency": "Suite: NEES of the back-ends.",
    "speed": "Suite: milliseconds a frame by stage.",
}


class _Suites(LazyGroup):
    """A name that is no module's is that of a suite, shipped or in a YAML file."""

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name == "detectors":
            return super().get_command(ctx, name)
        if name not in _COMMANDS and not name.endswith((".yaml", ".yml")):
            return None
        from vioframe.cli.bench_suite import suite_command

        return suite_command(name, _COMMANDS.get(name, f"The suite {name}."))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        # Not click's message, which knows nothing of suites in files.
        if args and not args[0].startswith("-") and self.get_command(ctx, args[0]) is None:
            from vioframe.bench.suites.suite import find

            find(args[0])
        return super().resolve_command(ctx, args)


@click.group("bench", cls=_Suites, modules="vioframe.cli.bench_{}", summaries=_COMMANDS)
def command() -> None:
    """Compare parts with one another: by a question to detectors, or by a suite.

    A suite is a YAML file of detectors, back-ends, sequences, conditions and seeds; `vioframe bench my_suite.yaml` runs
    one of your own. docs/bench.md says what is in it.
    """
