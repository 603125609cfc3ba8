"""Options for connections over Zenoh, used by ``host``, ``monitor`` and ``view``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    from skinnode.remote import SessionOptions

Router = Annotated[
    str | None,
    typer.Option(help="Connect through this Zenoh router, such as tcp/192.168.1.5:7447.", metavar="ENDPOINT"),
]
ZenohConfig = Annotated[
    Path | None, typer.Option(help="Zenoh configuration with TLS and access control.", metavar="FILE")
]
ZenohPort = Annotated[
    int | None,
    typer.Option(
        help="First of the 16 ports used by daemons on this machine; default 17447.", metavar="PORT"
    ),
]


class ZenohOptions(NamedTuple):
    """Values of the options for connections over Zenoh; None if not given."""

    router: str | None
    zenoh_config: Path | None
    zenoh_port: int | None
    listen: str | None = None

    def require_unused(self, allowed: str) -> None:
        """Raise ConfigError if an option is given; ``allowed`` states when it is allowed."""
        from skinnode.errors import ConfigError

        for name, value in self._asdict().items():
            if value is not None:
                got = value if isinstance(value, int) else str(value)
                raise ConfigError(f"--{name.replace('_', '-')}", got, allowed)

    def session(self, option: str) -> SessionOptions:
        """Return the options of the session.

        Args:
            option: Option that requires Zenoh, for the error message if a package is missing.

        Raises:
            ConfigError: if a package is missing, an endpoint is malformed or a port is out of range.
        """
        from skinnode.remote.session import PORT, SessionOptions, require_zenoh

        require_zenoh(option)
        port = PORT if self.zenoh_port is None else self.zenoh_port
        return SessionOptions(self.router, self.listen, self.zenoh_config, port)
