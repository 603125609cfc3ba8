"""Claims a hand for this process, so that each hand has only one daemon."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.messages.topics import HandTopics
from skinnode.process.closing import Closing
from skinnode.remote import discovery, keys
from skinnode.remote.session import SessionOptions, open_daemon, require_zenoh

if TYPE_CHECKING:
    import zenoh


class Claim(Closing):
    """Zenoh session of a hand's only daemon, open until :meth:`close` is called.

    Two daemons that start at the same moment may both be refused. Daemons that cannot reach each other, such
    as daemons on two machines whose router is not running, are both accepted.

    Args:
        hand: The hand.
        options: Connection options of the daemon.

    Raises:
        ConfigError: if another daemon publishes the hand or a hand with the same topics, a package is
            missing, or the connections cannot be opened.
    """

    def __init__(self, hand: HandConfig, options: SessionOptions | None = None) -> None:
        require_zenoh("--publish")
        self.hand = hand
        self.session: zenoh.Session = open_daemon(options or SessionOptions())
        try:
            zid = str(self.session.zid())
            self._token = self.session.liveliness().declare_token(keys.hand_token(hand.name, zid))
            self._refuse_others(zid)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the session."""
        self.session.close()

    def _refuse_others(self, zid: str) -> None:
        base = HandTopics.of(self.hand).base
        for token in discovery.tokens(self.session):
            other = keys.hand_of(token)
            if keys.zid_of(token) == zid or HandTopics.base_of(other) != base:
                continue
            if other == self.hand.name:
                allowed = "a hand that no other daemon publishes (stop the other daemon, or set another name)"
            else:
                allowed = f"a name that differs from the published hand {other!r} in letters or digits"
            raise ConfigError("name", self.hand.name, allowed, where=self.hand.where("name"))
