"""Opens Zenoh sessions for daemons and programs.

Without a router, daemons and programs on the same machine find each other on :data:`PORTS` fixed ports of
127.0.0.1: each daemon listens on the first free port, and daemons and programs connect to all of them.
Neither a broker nor multicast is needed. With a router, a daemon also connects to the router, and a program
connects only to the router.
"""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skinnode.errors import ConfigError, Shown
from skinnode.messages.typestore import require_mcap
from skinnode.process import clock

if TYPE_CHECKING:
    import zenoh

LOCAL: Final = "127.0.0.1"
PORT: Final = 17447
"""First port of daemons on this machine. Zenoh's own routers listen on 7447."""
PORTS: Final = 16
"""Number of ports, and thus the maximum number of daemons, on this machine."""

_RETRY: Final = {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2}
"""Pauses between attempts to connect, in ms. A connection on this machine is re-established within 0.2 s."""
_LEASE_MS: Final = 2000
"""Time without messages or keep-alives after which a connection is closed, in ms. A suspended process or an
unplugged cable is detected after this time; a process that ends is detected immediately."""
_QUEUED: Final = 16
"""Number of batches (64 KiB each) queued per connection; Zenoh's maximum. Zenoh's default, 2, is too small
for the fields of 16 patches that are solved at the same time."""
_SETTLE_S: Final = 1.0
"""Time limit for connecting to the router at startup, in s."""
_SETTLE_LOCAL_S: Final = 5.0
"""Time limit for connecting to the other daemons on this machine at startup, in s. It is reached only if the
machine is overloaded, or if a port belongs to another kind of program. A daemon that is not connected cannot
detect that another daemon already publishes its hand."""
_ROUTER_MS: Final = 500
"""Time limit for one attempt by a program to connect to a router, in ms."""
_PAUSE_S: Final = 0.1
"""Pause between these attempts, in s."""
_POLL_S: Final = 0.01
_ENDPOINT: Final = re.compile(r"(tcp|tls|udp|quic|ws)/(\[[^\]]+\]|[^/:\[\]]+):(\d{1,5})((?:[?#].*)?)")


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Connection options of a daemon or a program.

    Raises:
        ConfigError: if an endpoint is malformed or a number is out of range.
    """

    router: str | None = None
    """Endpoint of a Zenoh router, such as ``tcp/192.168.1.5:7447``."""
    listen: str | None = None
    """Endpoint on which a daemon listens in addition to its port on this machine."""
    config: Path | None = None
    """Zenoh configuration file in JSON5, for TLS and access control."""
    port: int = PORT
    """First daemon port on this machine."""

    def __post_init__(self) -> None:
        for option, endpoint in (("--router", self.router), ("--listen", self.listen)):
            if endpoint is not None:
                host_of(option, endpoint)
        if not 1024 <= self.port <= 65536 - PORTS:
            raise ConfigError("--zenoh-port", self.port, f"an integer from 1024 to {65536 - PORTS}")

    @property
    def exposed(self) -> str | None:
        """Non-local endpoint without TLS; None if there is none."""
        for option, endpoint in (("--router", self.router), ("--listen", self.listen)):
            encrypted = endpoint is None or endpoint.startswith(("tls/", "quic/"))
            if endpoint is not None and not encrypted and not _is_local(host_of(option, endpoint)):
                return endpoint
        return None


def host_of(option: str, endpoint: str) -> str:
    """Return the host part of an endpoint.

    Args:
        option: Name of the option, for the error message.
        endpoint: The endpoint.

    Raises:
        ConfigError: if the endpoint is malformed.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match[3]) < 65536:
        raise ConfigError(option, endpoint, "an endpoint such as tcp/192.168.1.5:7447 or tls/robot:7447")
    return match[2].strip("[]")


def require_zenoh(option: str) -> None:
    """Check that the packages of the ``zenoh`` extra are installed.

    Args:
        option: Option that requires them; used in the error message.

    Raises:
        ConfigError: A package is missing.
    """
    if find_spec("zenoh") is None:
        allowed = "the packages of the zenoh extra (install: sh install.sh zenoh)"
        raise ConfigError(option, Shown("no package eclipse-zenoh"), allowed)
    require_mcap(option)


def require_protected(options: SessionOptions, *, commands: bool) -> None:
    """Check that commands from other machines are possible only with TLS.

    Args:
        options: Connections of the daemon.
        commands: Whether the daemon accepts commands.

    Raises:
        ConfigError: if the daemon accepts commands over a non-local endpoint without TLS.
    """
    if commands and options.exposed is not None:
        allowed = "only with endpoints on this machine, or tls/… with --zenoh-config"
        raise ConfigError("--commands", Shown(options.exposed), allowed)


def open_daemon(options: SessionOptions) -> zenoh.Session:
    """Open a daemon's session and wait for connections to the other daemons and to the router.

    Raises:
        ConfigError: if the configuration is invalid, all ports are in use, or ``options.listen`` cannot be
            opened.
    """
    import zenoh

    extra = [] if options.listen is None else [options.listen]
    router = [] if options.router is None else [options.router]
    taken = "in use"
    for port in range(options.port, options.port + PORTS):
        if _accepts(port):
            continue
        others = [_local(each) for each in range(options.port, port)]
        settings = {"mode": "peer", "listen": _ends(_local(port), *extra), "connect": _ends(*router, *others)}
        try:
            session = zenoh.open(_config(options, settings))
        except zenoh.ZError as error:
            if "in use" in str(error) and options.listen is None:
                continue  # another daemon has just taken this port
            raise _refused(options, error) from None
        _settle(session, options, port)
        return session
    last = options.port + PORTS - 1
    raise ConfigError(
        "--zenoh-port", options.port, f"a free port from {options.port} to {last} (all are {taken})"
    )


def open_program(options: SessionOptions, end_s: float | None) -> zenoh.Session:
    """Open a program's session. A lost connection is re-established in the background.

    Without a router, daemons may appear later. With a router, this function waits until the router answers.

    Args:
        options: Connection options of the program.
        end_s: Monotonic time until which to wait for the router, in s; None for no limit.

    Raises:
        ConfigError: if the configuration is invalid, or the router does not answer in time.
    """
    import zenoh

    if options.router is None:
        ports = range(options.port, options.port + PORTS)
        settings = {"mode": "peer", "listen": _ends(), "connect": _ends(*map(_local, ports))}
    else:
        settings = {"mode": "client", "listen": _ends(), "connect": _ends(options.router)}
    config = _config(options, settings)
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if options.router is None:
                raise _refused(options, error) from None
            if end_s is not None and clock.monotonic() >= end_s:
                allowed = f"an endpoint where a router or daemon answers ({_first_line(error)})"
                raise ConfigError("router", options.router, allowed) from None
        clock.sleep(_PAUSE_S)


def _config(options: SessionOptions, settings: dict[str, Any]) -> zenoh.Config:
    import zenoh

    try:
        config = zenoh.Config() if options.config is None else zenoh.Config.from_file(options.config)
    except zenoh.ZError as error:
        allowed = f"a Zenoh configuration file in JSON5 ({_first_line(error)})"
        raise ConfigError("--zenoh-config", str(options.config), allowed) from None
    fixed = {
        "mode": settings["mode"],
        "listen/endpoints": settings["listen"],
        "listen/exit_on_failure": True,
        "connect/endpoints": settings["connect"],
        "connect/timeout_ms": -1 if settings["mode"] == "peer" else _ROUTER_MS,
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "open/return_conditions/connect_scouted": False,  # do not wait for absent peers
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/link/tx/queue/size/data": _QUEUED,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    for key, value in fixed.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _ends(*endpoints: str) -> list[str]:
    return list(endpoints)


def _local(port: int) -> str:
    return f"tcp/{LOCAL}:{port}"


def _accepts(port: int) -> bool:
    """Return whether a program is listening on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex((LOCAL, port)) == 0


def _settle(session: zenoh.Session, options: SessionOptions, own: int) -> None:
    """Wait until the session is connected to the other daemons and to the router."""
    ports = range(options.port, options.port + PORTS)
    others = sum(_accepts(port) for port in ports if port != own)
    begin_s = clock.monotonic()
    while (waited_s := clock.monotonic() - begin_s) < _SETTLE_LOCAL_S:
        routed = options.router is None or waited_s >= _SETTLE_S or session.info.routers_zid()
        if routed and len(session.info.peers_zid()) >= others:
            return
        clock.sleep(_POLL_S)


def _is_local(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _refused(options: SessionOptions, error: Exception) -> ConfigError:
    """Return the error for endpoints or a configuration that Zenoh rejected."""
    listen, router = ("--listen", options.listen), ("--router", options.router)
    option, value = listen if options.listen is not None else router
    if value is None:
        option, value = "--zenoh-config", str(options.config)
    return ConfigError(option, value, f"a free endpoint that Zenoh can open ({_first_line(error)})")


def _first_line(error: Exception) -> str:
    """Return the message of a Zenoh error, without the locations in Zenoh's source code."""
    text = re.sub(r" at /\S+?\.rs:\d+\.?", "", " ".join(str(error).split()))
    return text[:200]
