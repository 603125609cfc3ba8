"""Who may connect and who may command: TLS and access control of Zenoh, on the loopback interface."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import skinnode as sk
from skinnode.errors import ConfigError, SkinError
from skinnode.remote import SessionOptions
from skinnode.remote.session import require_protected
from tests.remote import certificates
from tests.remote.conftest import Process
from tests.remote.ports import free_ports

pytestmark = pytest.mark.system_time


@pytest.mark.long
@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs the program openssl")
def test_only_the_operator_commands_and_only_with_a_certificate(
    start: Callable[..., Process], tmp_path: Path
) -> None:
    certificates.make(tmp_path, "robot", "operator", "guest")
    endpoint = f"tls/localhost:{free_ports(1)}"
    config = certificates.guarded(tmp_path, "robot", "operator")
    daemon = start(listen=endpoint, config=str(config), commands=True).wait_until_up()

    with sk.connect("hand", router=endpoint, config=certificates.config(tmp_path, "guest")) as hand:
        assert hand.fields().get(30.0) is not None
        with pytest.raises(SkinError, match=r"no reply to tare within 2 s.*access control"):
            hand.tare("p0", deadline_s=0.0)
        assert json.loads(daemon.tell("baselines"))["p0"] == 0
    with sk.connect("hand", router=endpoint, config=certificates.config(tmp_path, "operator")) as hand:
        hand.tare("p0")
        assert json.loads(daemon.tell("baselines"))["p0"] >= 1  # one read again counts again

    stranger = tmp_path / "stranger"
    stranger.mkdir()
    certificates.make(stranger, "operator")  # the right name, signed by another authority
    (stranger / "ca.pem").write_bytes((tmp_path / "ca.pem").read_bytes())
    for unknown in (certificates.config(stranger, "operator"), None):
        with pytest.raises(ConfigError, match=r"router: got .*a router or daemon answers"):
            sk.connect("hand", router=endpoint, config=unknown, timeout_s=1.0)


@pytest.mark.parametrize(
    ("options", "refused"),
    [
        ({"listen": "tcp/0.0.0.0:7447"}, True),
        ({"router": "tcp/192.168.1.5:7447"}, True),
        ({"router": "udp/robot:7447"}, True),
        ({"listen": "tls/0.0.0.0:7447"}, False),
        ({"router": "tcp/127.0.0.1:7447", "listen": "tcp/[::1]:7448"}, False),
        ({"router": "tcp/localhost:7447"}, False),
        ({}, False),
    ],
)
def test_commands_leave_the_machine_only_by_tls(options: dict[str, str], refused: bool) -> None:
    if refused:
        with pytest.raises(
            ConfigError, match=r"--commands: got .*, allowed: only with endpoints on this machine"
        ):
            require_protected(SessionOptions(**options), commands=True)
    else:
        require_protected(SessionOptions(**options), commands=True)
    require_protected(SessionOptions(**options), commands=False)


@pytest.mark.parametrize("endpoint", ["", "robot", "tcp/robot", "tcp/robot:0", "tcp/robot:99999", "a/b:1"])
def test_a_malformed_endpoint_is_refused(endpoint: str) -> None:
    with pytest.raises(ConfigError, match=r"--router: got .*, allowed: an endpoint such as tcp/"):
        SessionOptions(router=endpoint)


def test_other_machines_cannot_reach_a_daemon(start: Callable[..., Process], port: int) -> None:
    daemon = start().wait_until_up()
    inodes = {
        link.readlink().name for link in Path(f"/proc/{daemon.process.pid}/fd").iterdir() if link.is_symlink()
    }
    listening = set()  # the kernel can list a socket twice while others open and close
    for table in ("tcp", "tcp6"):
        for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = row.split()[:10]
            if state == "0A" and f"socket:[{inode}]" in inodes:
                listening.add((local.split(":")[0], int(local.split(":")[1], 16)))
    assert listening == {("0100007F", port)}  # 127.0.0.1
