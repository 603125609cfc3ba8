"""Connects a program to a hand that a daemon publishes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from skinnode.errors import ConfigError, SkinError
from skinnode.host.publish import check_timeout
from skinnode.process import clock
from skinnode.remote.description import Description, ask
from skinnode.remote.discovery import published_hands, tokens
from skinnode.remote.remote_hand import RemoteHand
from skinnode.remote.session import PORT, SessionOptions, open_program, require_zenoh

if TYPE_CHECKING:
    import zenoh

TIMEOUT_S: Final = 5.0
"""Default time limit for the hand to appear, in s."""
_POLL_S: Final = 0.02


def connect(
    hand: str,
    *,
    timeout_s: float | None = TIMEOUT_S,
    router: str | None = None,
    config: Path | str | None = None,
    port: int = PORT,
) -> RemoteHand:
    """Connect to a hand that ``skinnode host --publish`` publishes on this machine, or through a router.

    Example::

        with sk.connect("left hand") as hand:
            for field in hand.fields():
                ...

    Args:
        hand: Name of the hand (``name`` in the hand file).
        timeout_s: Time limit (s) for the hand to appear; None for no limit.
        router: Endpoint of a Zenoh router, such as ``tcp/192.168.1.5:7447``.
        config: Zenoh configuration file in JSON5, for TLS and access control.
        port: First port of the daemons on this machine.

    Raises:
        ConfigError: if no such hand is published in time, the router does not answer, the name or an option
            is invalid, or a package is missing.
        SkinError: if the daemon does not describe the hand in time, or runs a different version of skinnode.
        ValueError: if ``timeout_s`` is out of range.
    """
    check_timeout(timeout_s)
    if not hand.isprintable() or not hand.strip():  # no hand file contains such a name, and no key can
        raise ConfigError("hand", hand, "the name of a hand: printable characters, not all blank")
    require_zenoh("connect")
    options = SessionOptions(router, None, None if config is None else Path(config), port)
    end_s = None if timeout_s is None else clock.monotonic() + timeout_s
    session = open_program(options, end_s)
    closing: RemoteHand | zenoh.Session = session
    try:
        closing = remote = RemoteHand(session, _described(session, hand, end_s, options))
        while not remote.ready:
            if _over(end_s):
                why = f"its daemon sent no health within {timeout_s:g} s; connect again"
                raise SkinError(f"hand {hand!r}: {why}")
            clock.sleep(_POLL_S)
    except BaseException:
        closing.close()
        raise
    return remote


def _described(
    session: zenoh.Session, hand: str, end_s: float | None, options: SessionOptions
) -> Description:
    """Wait for the hand's daemon to appear and send its description."""
    while True:
        present = bool(tokens(session, hand))
        description = ask(session, hand) if present else None
        if description is not None:
            return description
        if _over(end_s):
            break
        clock.sleep(_POLL_S)
    if present:
        raise SkinError(
            f"hand {hand!r}: its daemon is starting and has not described the hand yet; connect again"
        )
    others = published_hands(session)
    if others:
        raise ConfigError("hand", hand, f"one of the published hands: {', '.join(map(repr, others))}")
    where = "on this machine" if options.router is None else f"at the router {options.router}"
    start = "start skinnode host HAND.toml --publish"
    raise ConfigError("hand", hand, f"a published hand; none is published {where} ({start})")


def _over(end_s: float | None) -> bool:
    return end_s is not None and clock.monotonic() >= end_s
