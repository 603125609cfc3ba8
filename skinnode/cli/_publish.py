"""Options of ``skinnode host`` for publishing the hand over Zenoh, and the publication itself."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from skinnode.cli._run_report import Report
    from skinnode.cli._zenoh_options import ZenohOptions
    from skinnode.config import HandConfig
    from skinnode.host import Host
    from skinnode.remote import SessionOptions
    from skinnode.remote.claim import Claim

Publish = Annotated[
    bool, typer.Option("--publish", help="Publish fields, health and events over Zenoh, on this machine.")
]
Commands = Annotated[
    bool, typer.Option("--commands", help="With --publish: programs may tare patches and reset nodes.")
]
Listen = Annotated[
    str | None,
    typer.Option(help="With --publish: another endpoint, such as tls/0.0.0.0:7447.", metavar="ENDPOINT"),
]


class AskedPublication:
    """Publication of a hand; does nothing unless ``options`` are given.

    Args:
        options: Connections; None to publish nothing.
        commands: Whether programs may send commands to the hand.
    """

    def __init__(self, options: SessionOptions | None, *, commands: bool) -> None:
        self._options, self._commands = options, commands
        self._claim: Claim | None = None

    @contextlib.contextmanager
    def claimed(self, plan: HandConfig) -> Iterator[None]:
        """Claim the hand; raises ConfigError if another daemon publishes it."""
        if self._options is None:
            yield
            return
        from skinnode.remote.claim import Claim

        with Claim(plan, self._options) as self._claim:
            yield

    @contextlib.contextmanager
    def running(self, host: Host, report: Report) -> Iterator[None]:
        """Publish a running host, and report the counters at the end."""
        if self._claim is None:
            yield
            return
        from skinnode.remote import Publication
        from skinnode.text.words import counted

        with Publication(host, self._claim, commands=self._commands) as publication:
            report.note(f"published as {host.hand.name!r}{', with commands' if self._commands else ''}")
            yield
        stats = publication.stats()
        report.note(f"published {counted(sum(stats.published.values()), 'field')}; dropped {stats.dropped}")


def asked_publication(connections: ZenohOptions, *, publish: bool, commands: bool) -> AskedPublication:
    """Return the publication requested by the options.

    Raises:
        ConfigError: if an option is invalid or is given without ``--publish``, or a package is missing.
    """
    from skinnode.errors import ConfigError, Shown

    if not publish:
        connections.require_unused("only with --publish")
        if commands:
            raise ConfigError("--commands", Shown("no --publish"), "only with --publish")
        return AskedPublication(None, commands=False)
    options = connections.session("--publish")
    from skinnode.remote.session import require_protected

    require_protected(options, commands=commands)
    return AskedPublication(options, commands=commands)
