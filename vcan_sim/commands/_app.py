"""Typer application for ``vcan-sim`` and its commands."""

from __future__ import annotations

from typing import Any, Final

from skinnode.cli._help import App, Group
from vcan_sim.commands import inject, list_scenes, replay, run

DEFAULT: Final = "run"
"""Command to run if none is named."""
_OF_GROUP: Final = ("-h", "--help", "--install-completion", "--show-completion")


class _Group(Group):
    """Command group in which the name of the default command may be omitted."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, after inserting the default command if none is named."""
        completes_first_word = ctx.resilient_parsing and not args
        if not completes_first_word and (not args or args[0] not in (*self.commands, *_OF_GROUP)):
            args = [DEFAULT, *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Return completions for the first word: commands, and options of the default command."""
        own, of_default = (
            super().shell_complete(ctx, incomplete),
            self.commands[DEFAULT].shell_complete(ctx, incomplete),
        )
        known = {item.value for item in own}
        return own + [item for item in of_default if item.value not in known]


app = App(
    name="vcan-sim",
    cls=_Group,
    help="Simulate patches of robot skin as CANopen nodes. If no command is given, `run` is used.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(name="run")(run.run)
app.command(name="inject")(inject.inject)
app.command(name="list")(list_scenes.list_scenes)
app.command(name="replay")(replay.replay)
