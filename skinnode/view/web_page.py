"""Serves the rerun-sdk viewer to a browser, without contacting other computers.

The SDK's page loads fonts from other computers, and its viewer sends usage statistics. This server removes
the fonts from the page and adds a content security policy, so the browser blocks every connection except
those to this server and to the data port. The page also disables the statistics setting that the viewer
stores in the browser.
"""

from __future__ import annotations

import http.client
import re
import shutil
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final
from urllib.parse import parse_qsl, urlencode, urlsplit

from skinnode.process.closing import Closing
from skinnode.view.viewer_process import in_url, reachable, require_free

_FILES: Final = ("/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico", "/apple-touch-icon.png")
_ELSEWHERE: Final = re.compile(
    rb"<link\b[^>]*https?://[^>]*>|<script\b[^>]*\bsrc=\"https?://[^>]*>\s*</script>"
)
"""Page elements that load resources from other computers."""
_HOST: Final = re.compile(r"[A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\]")
_NO_STATISTICS: Final = (
    b"<script>localStorage.setItem('rerun_config', "
    b"JSON.stringify({analytics_id: 'none', analytics_enabled: false}));</script>"
)
_OPTIONS: Final = {"hide_welcome_screen": "1", "persist": "0"}
"""Query string of the page; disables the welcome screen, which would load examples, and the layout saved
during an earlier visit."""


class WebPage(Closing):
    """Web server for the viewer's page, from construction until :meth:`close`.

    Args:
        address: Address on which to listen.
        port: Port on which to listen.
        data_port: Port from which the browser fetches the data.
        files_port: Port on the same address, on which the SDK serves its viewer files.

    Raises:
        ConfigError: The port is in use or the address does not belong to this machine.
    """

    def __init__(self, address: str, port: int, data_port: int, files_port: int) -> None:
        require_free(address, port)

        class Handler(_Handler):
            ports = (data_port, files_port)
            files_address = reachable(address)
            otherwise = in_url(address)

        kind = type("Server", (ThreadingHTTPServer,), {"address_family": _family(address)})
        self._server: ThreadingHTTPServer = kind((address, port), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="web page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def policy(host: str, data_port: int) -> str:
    """Return the page's content security policy.

    Args:
        host: Name or address by which the browser knows this computer.
        data_port: Port from which the browser fetches the data.
    """
    return (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
        "style-src 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self' blob:; "
        "object-src 'none'; base-uri 'none'; "
        f"connect-src 'self' blob: data: http://{host}:{data_port}"
    )


def page_of(page: bytes) -> bytes:
    """Return the SDK's page without external elements and with usage statistics disabled."""
    return _ELSEWHERE.sub(b"", page).replace(b"<head>", b"<head>" + _NO_STATISTICS, 1)


class _Handler(BaseHTTPRequestHandler):
    """Answers GET requests for the page and the viewer files; returns 404 for every other path."""

    ports: tuple[int, int]
    files_address: str
    otherwise: str
    """Host name used if the browser's request has no valid ``Host`` header."""
    protocol_version = "HTTP/1.1"
    timeout = 30.0

    def do_GET(self) -> None:
        """Answer a request."""
        path, query = urlsplit(self.path).path, dict(parse_qsl(urlsplit(self.path).query))
        try:
            if path in _FILES:
                self._pass_on(path)
            elif path != "/":
                self._answer(404, "text/plain", b"not found")
            elif "url" in query:
                self._answer(200, "text/html; charset=utf-8", page_of(self._fetch("/")))
            else:
                self.send_response(302)
                self.send_header("Location", "/?" + urlencode({"url": self._data_url(), **_OPTIONS, **query}))
                self.send_header("Content-Length", "0")
                self.end_headers()
        except (OSError, http.client.HTTPException):
            self.close_connection = True  # the browser or the SDK's server has disconnected

    def _host(self) -> str:
        """Return this computer's name from the request's ``Host`` header, without the port."""
        named = re.sub(r":\d+$", "", self.headers.get("Host", ""))
        return named if _HOST.fullmatch(named) else self.otherwise

    def _data_url(self) -> str:
        return f"rerun+http://{self._host()}:{self.ports[0]}/proxy"

    def _files(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(self.files_address, self.ports[1], timeout=self.timeout)

    def _fetch(self, path: str) -> bytes:
        connection = self._files()
        connection.request("GET", path)
        with connection.getresponse() as answer:
            return answer.read()

    def _pass_on(self, path: str) -> None:
        """Pass on an SDK file in chunks, because the largest file is 43 MB."""
        connection = self._files()
        connection.request("GET", path)
        with connection.getresponse() as answer:
            self.send_response(answer.status)
            self.send_header("Content-Type", answer.getheader("Content-Type", "application/octet-stream"))
            length = answer.getheader("Content-Length") or answer.getheader("rerun-final-length")
            if length is not None:
                self.send_header("Content-Length", length)
            self.send_header("rerun-final-length", answer.getheader("rerun-final-length") or "")
            self.send_header("Cache-Control", "max-age=3600")
            self.send_header("Connection", "close")
            self.end_headers()
            shutil.copyfileobj(answer, self.wfile, 1 << 18)
        self.close_connection = True

    def _answer(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", policy(self._host(), self.ports[0]))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Print nothing, because stderr is reserved for the command's messages."""


def _family(address: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in address else socket.AF_INET
