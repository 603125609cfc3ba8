"""Opens the outputs of a drawing: a window or a web page, a file, or both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinnode.errors import ConfigError
from skinnode.view.viewer_process import (
    LOCAL,
    MEMORY,
    ViewerProcess,
    free_port,
    in_url,
    require_display,
    require_free,
)
from skinnode.view.web_page import WebPage

PORT: Final = 9090
"""Default port of the web page; the browser fetches the data from the next port."""
SUFFIX: Final = ".rrd"


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """Outputs of a drawing."""

    window: bool
    web: bool
    save: Path | None
    address: str = LOCAL
    port: int = PORT


@dataclass(frozen=True, slots=True)
class Output:
    """An open output."""

    viewer: ViewerProcess | None
    """Window, or data server for browsers; None if the drawing goes only to a file."""
    page_url: str | None
    """URL of the web page; None if there is no web page."""
    save: Path | None
    """File to write; None if no file is written."""

    def target(self, name: str) -> Target:
        """Return the viewer and file to draw to.

        Args:
            name: Name of the recording, shown in the viewer.
        """
        return Target(None if self.viewer is None else self.viewer.url, self.save, name)


@dataclass(frozen=True, slots=True)
class Target:
    """Viewer and file to which the SDK sends a drawing."""

    url: str | None
    """URL of the viewer; None if there is no viewer."""
    save: Path | None
    """File to write; None if no file is written."""
    name: str
    """Name of the recording, shown in the viewer."""


@contextmanager
def open_output(options: OutputOptions) -> Iterator[Output]:
    """Check the file and start the viewer; end the viewer on exit.

    Args:
        options: Outputs to open.

    Raises:
        ConfigError: There is no display, a port is in use, or the file exists or cannot be written.
        SkinError: The viewer does not start.
    """
    if options.save is not None:
        require_new_file(options.save)
    with ExitStack() as stack:
        viewer, page_url = None, None
        if options.web:
            viewer, page_url = _serve(stack, options)
        elif options.window:
            require_display()
            shown = ["--expect-data-soon", "--hide-welcome-screen"]
            viewer = stack.enter_context(ViewerProcess(LOCAL, free_port(), shown))
        yield Output(viewer, page_url, options.save)


def require_new_file(path: Path) -> None:
    """Raise ConfigError if ``path`` is not the name of a new, writable recording file."""
    if path.suffix != SUFFIX:
        raise ConfigError("--save", str(path), f"a file name that ends in {SUFFIX}")
    try:
        with path.open("xb"):
            pass
        path.unlink()
    except FileExistsError:
        raise ConfigError("--save", str(path), "a new file; this one already exists") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise ConfigError("--save", str(path), f"a file that can be created ({why})") from None


def _serve(stack: ExitStack, options: OutputOptions) -> tuple[ViewerProcess, str]:
    """Start the data server and the web page."""
    address, port = options.address, options.port
    require_free(address, port)
    files_port = free_port()
    asked = ["--serve-web", "--web-viewer-port", str(files_port), "--server-memory-limit", MEMORY]
    if address != LOCAL:
        asked += ["--cors-allow-origin", f"http://*:{port}"]
    viewer = stack.enter_context(ViewerProcess(address, port + 1, asked, files_port=files_port))
    stack.enter_context(WebPage(address, port, port + 1, files_port))
    return viewer, f"http://{in_url(address)}:{port}/"
