"""The page for browsers: what it serves, on which addresses, and that it reaches no other computer."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from skinnode.errors import ConfigError, SkinError
from skinnode.view import viewer_process
from skinnode.view.outputs import OutputOptions, open_output
from skinnode.view.viewer_process import LOCAL, ViewerProcess, free_port, require_display, require_free
from skinnode.view.web_page import WebPage

PAGE = b"""<html><head>
<link rel="icon" href="favicon.ico" />
<link rel="preconnect" href="https://fonts.example" crossorigin />
<link
  href="https://fonts.example/css2?family=Inter"
  rel="stylesheet"
/></head><script src="re_viewer.js"></script><script src="https://elsewhere.example/x.js"></script></html>"""

_PROGRAM = """\
#!{python}
import http.server, socket, sys, threading, time

given = dict(zip(sys.argv[1::1], sys.argv[2::1]))
address = given["--bind"]

class Server(http.server.ThreadingHTTPServer):
    address_family = socket.AF_INET6 if ":" in address else socket.AF_INET

class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        self.wfile.write({page})

data = Server((address, int(given["--port"])), Handler)
threading.Thread(target=data.serve_forever, daemon=True).start()
time.sleep(0.3)  # the SDK's program, too, opens this port later
Server((address, int(given["--web-viewer-port"])), Handler).serve_forever()
"""
"""Program in the place of the SDK's."""


@pytest.fixture
def files() -> Iterator[int]:
    """Port of a server in the place of the SDK's."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = PAGE if self.path == "/" else b"\0asm" + bytes(300_000)
            self.send_response(200)
            self.send_header("Content-Type", "text/html" if self.path == "/" else "application/wasm")
            self.send_header("rerun-final-length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer((LOCAL, 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


def get(port: int, path: str, host: str | None = None) -> tuple[int, http.client.HTTPMessage, bytes]:
    connection = http.client.HTTPConnection(LOCAL, port, timeout=20.0)
    try:
        connection.request("GET", path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        return answer.status, answer.msg, answer.read()
    finally:
        connection.close()


def test_the_page_sends_the_browser_to_the_data_and_nowhere_else(files: int) -> None:
    port = free_port()
    with WebPage(LOCAL, port, 5555, files):
        status, head, _ = get(port, "/?renderer=webgl")
        query = parse_qs(urlsplit(head["Location"]).query)
        assert status == 302
        assert query["url"] == ["rerun+http://127.0.0.1:5555/proxy"]
        assert query["renderer"] == ["webgl"]
        status, head, page = get(port, head["Location"])
        assert status == 200
        assert re.findall(rb"https?://[^\"' ]*", page) == []
        assert b'src="re_viewer.js"' in page
        assert b"analytics_enabled: false" in page
        rules = dict(rule.strip().split(" ", 1) for rule in head["Content-Security-Policy"].split(";"))
        assert rules["default-src"] == "'self'"
        assert rules["connect-src"] == "'self' blob: data: http://127.0.0.1:5555"
        assert not any("http" in rule for name, rule in rules.items() if name != "connect-src")


def test_another_name_of_this_computer_is_kept_and_a_forged_one_is_not(files: int) -> None:
    port = free_port()
    with WebPage(LOCAL, port, 5555, files):
        _, head, _ = get(port, "/", host=f"robot.local:{port}")
        assert parse_qs(urlsplit(head["Location"]).query)["url"] == ["rerun+http://robot.local:5555/proxy"]
        _, head, _ = get(port, "/?url=x", host="a; script-src http://evil.example")
        assert "evil" not in head["Content-Security-Policy"]
        assert "http://127.0.0.1:5555" in head["Content-Security-Policy"]


@pytest.mark.long
def test_files_of_the_viewer_are_passed_on_and_no_others(files: int) -> None:
    port = free_port()
    with WebPage(LOCAL, port, 5555, files):
        status, head, body = get(port, "/re_viewer_bg.wasm")
        assert (status, head["Content-Type"], len(body)) == (200, "application/wasm", 300_004)
        for path in ("/etc/passwd", "/../secret", "/api/x", "//elsewhere.example/"):
            assert get(port, path)[0] == 404


def test_a_browser_that_leaves_disturbs_nobody(files: int, capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    with WebPage(LOCAL, port, 5555, files):
        for _ in range(5):
            with socket.create_connection((LOCAL, port)) as gone:
                gone.sendall(b"GET /re_viewer_bg.wasm HTTP/1.1\r\n\r\n")
        assert get(port, "/?url=x")[0] == 200
    assert capfd.readouterr() == ("", "")


@pytest.mark.long
@pytest.mark.parametrize(("address", "in_url"), [("127.0.0.2", "127.0.0.2"), ("::1", "[::1]")])
def test_a_page_on_one_address_of_this_computer_has_its_files_from_there(
    address: str, in_url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The SDK's program listens only on the given address; so does the program in its place."""
    program = tmp_path / "rerun"
    program.write_text(_PROGRAM.format(python=sys.executable, page=PAGE))
    program.chmod(0o700)
    monkeypatch.setattr(viewer_process, "_program", lambda: program)
    port = free_port()
    options = OutputOptions(window=False, web=True, save=None, address=address, port=port)
    with open_output(options) as output:
        assert output.page_url == f"http://{in_url}:{port}/"
        assert output.target("hand").url == f"rerun+http://{in_url}:{port + 1}/proxy"
        connection = http.client.HTTPConnection(address, port, timeout=20.0)
        connection.request("GET", "/?url=x")
        answer = connection.getresponse()
        assert answer.status == 200
        assert b'src="re_viewer.js"' in answer.read()
        assert f"http://{in_url}:{port + 1}" in answer.headers["Content-Security-Policy"]
        connection.close()


def test_a_port_in_use_and_a_foreign_address_are_told() -> None:
    with socket.socket() as used:
        used.bind((LOCAL, 0))
        used.listen()
        port = used.getsockname()[1]
        with pytest.raises(
            ConfigError, match=rf"got '127.0.0.1:{port}', allowed: a free port \(Address already"
        ):
            require_free(LOCAL, port)
    with pytest.raises(ConfigError, match="a free port"):
        require_free("203.0.113.7", 9090)
    with pytest.raises(ConfigError, match="a free port"):
        require_free("no address", 9090)


def test_no_display_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ConfigError, match="a graphical session, or --web, or --save"):
        require_display()


def test_a_viewer_that_does_not_start_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\necho 'cannot open the display :7' >&2\nexit 1\n")
    program.chmod(0o700)
    monkeypatch.setattr(viewer_process, "_program", lambda: program)
    with pytest.raises(SkinError, match="the viewer ended: cannot open the display :7"):
        ViewerProcess(LOCAL, free_port(), [])


def listening(pid: int) -> set[str]:
    """Local addresses on which a process listens, as the kernel lists them."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        try:
            inodes.add(os.readlink(entry).removeprefix("socket:[").removesuffix("]"))
        except OSError:
            continue
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            cells = line.split()
            if cells[3] == "0A" and cells[9] in inodes:  # state LISTEN
                found.add(cells[1])
    return found


@pytest.fixture
def shown(sdk: None) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The command with a page, and its port."""
    port = free_port()
    code = "from skinnode.cli.main import main; main()"
    command = [sys.executable, "-c", code, "view", "--simulate", "--web", "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == f"open http://127.0.0.1:{port}/ in a browser; press Ctrl-C to stop\n"
    yield process, port
    process.kill()
    process.communicate()


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def viewer_of(process: subprocess.Popen[str]) -> int:
    (viewer,) = (
        child
        for child in children(process.pid)
        if Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")[0].endswith(b"/rerun")
    )
    return viewer


def ended(pid: int, within_s: float = 10.0) -> bool:
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.real_time
def test_the_command_listens_on_this_machine_only_and_sends_no_statistics(
    shown: tuple[subprocess.Popen[str], int],
) -> None:
    process, port = shown
    viewer = viewer_of(process)
    assert {address.split(":")[0] for address in listening(process.pid) | listening(viewer)} == {"0100007F"}
    environment = dict(
        entry.split("=", 1) for entry in Path(f"/proc/{viewer}/environ").read_text().split("\0") if entry
    )
    told = subprocess.run(
        [os.readlink(f"/proc/{viewer}/exe"), "analytics", "config"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(told.stdout)["analytics_enabled"] is False
    _, head, _ = get(port, "/")
    status, _, page = get(port, head["Location"])
    assert status == 200
    assert re.findall(rb"<(?:link|script)[^>]*https?://", page) == []
    assert b"re_viewer.js" in page
    status, head, body = get(port, "/re_viewer_bg.wasm")
    assert body[:4] == b"\0asm"
    assert len(body) == int(head["Content-Length"])
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60.0)
    assert process.returncode in (0, 1), err  # 1 if a fault of the simulated hand was seen
    assert "Traceback" not in err
    assert ended(viewer)


@pytest.mark.real_time
def test_a_command_that_is_killed_leaves_no_viewer(shown: tuple[subprocess.Popen[str], int]) -> None:
    process, _ = shown
    viewer = viewer_of(process)
    process.kill()
    assert ended(viewer)


@pytest.mark.real_time
def test_a_viewer_that_dies_ends_the_command_with_one_line(
    shown: tuple[subprocess.Popen[str], int],
) -> None:
    process, _ = shown
    assert process.stderr is not None
    os.kill(viewer_of(process), signal.SIGKILL)
    _, err = process.communicate(timeout=60.0)
    assert process.returncode == 2
    assert [line for line in err.splitlines() if line.startswith("error: ")] == err.splitlines()
    assert err.startswith("error: the viewer ended: Killed")
