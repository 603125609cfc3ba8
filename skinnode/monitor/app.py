"""Full-screen application that redraws the newest view several times a second and handles keys."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, Final

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType

from skinnode.errors import SkinError
from skinnode.monitor.field_map import Colours, Scale
from skinnode.monitor.screen import screen
from skinnode.monitor.session_faults import FaultBook
from skinnode.monitor.source import Source
from skinnode.monitor.terminal_driver import PatientDriver
from skinnode.monitor.theme import Paint, UiState, theme_for
from skinnode.monitor.view_model import History, Level, LogLine, View, log_line, time_of_day
from skinnode.monitor.widgets import Canvas, Dialog

PERIOD_S: Final = 0.1
"""Minimum interval between screen updates, in seconds."""
SHARE: Final = 0.2
"""Maximum fraction of one CPU core's time that drawing may use.

If drawing is slow, the screen is updated less often.
"""
SLOWEST_S: Final = 0.5

_LOG_LINES: Final = 500
_BEGIN_S: Final = 3.0
_MESSAGE_S: Final = 5.0

HELP: Final = """\
 1 … 9, ← →, tab   select a patch
 z, enter          show that patch alone, or all (also esc)
 t, T              tare that patch, or all patches: the current reading becomes zero
 n                 reset that patch's node (NMT); the host brings it up again
 r                 start or stop a recording
 space             freeze the display; the host continues
 a                 show or hide shear arrows on the maps
 q, ctrl-c         quit

 Brighter colours mean a deeper press; the scale next to "touches" shows
 the depth. Arrows show shear: right is along the upper wires, up is
 across them. A map without colours is out of date, because its patch
 sends no data."""

_SHOWN_AS_EVENTS: Final = ("skinnode.host.supervisor", "skinnode.host.health")
"""Names of loggers whose warnings already appear in the event log as events."""


class MonitorApp(App[None]):
    """Full-screen monitor for a data source.

    Args:
        source: Host, remote hand or recording; the caller must close it.
        folder: Folder for recordings.
        colours: Colours of the terminal.
        over: Function called at each screen update; the monitor ends when it returns True.
        seconds: Maximum duration; None for no limit.
    """

    ENABLE_COMMAND_PALETTE = False
    CSS = "Screen { background: #11131a; } Screen:ansi { background: ansi_default; }"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q,ctrl+c,ctrl+q", "leave", "quit", priority=True),
        Binding("right,tab,l", "choose(1)", "next patch", priority=True),
        Binding("left,shift+tab,h", "choose(-1)", "previous patch", priority=True),
        *[Binding(str(number), f"choose_number({number})", "patch") for number in range(1, 10)],
        Binding("z,enter", "zoom", "zoom"),
        Binding("escape", "unzoom", "back"),
        Binding("t", "tare(False)", "tare"),
        Binding("T", "tare(True)", "tare all"),
        Binding("n", "reset", "reset the node"),
        Binding("r", "record", "record"),
        Binding("space,p", "pause", "pause"),
        Binding("a", "arrows", "arrows"),
        Binding("question_mark,f1", "help", "help"),
    ]

    def __init__(
        self,
        source: Source,
        *,
        folder: Path,
        colours: Colours,
        over: Callable[[], bool] = lambda: False,
        seconds: float | None = None,
    ) -> None:
        super().__init__(driver_class=PatientDriver, ansi_color=colours != "rgb")
        self.faults = FaultBook(live=source.live)
        self.failure: SkinError | None = None
        """Error that ended the monitor; None if no error has occurred."""
        self._source, self._folder, self._over, self._seconds = source, folder, over, seconds
        self._theme = theme_for(colours)
        self.canvas = Canvas()
        self._names = [patch.name for patch in source.hand.patches]
        self._selected = 0
        self._zoomed = self._paused = False
        self._arrows = True
        self._message: tuple[float, str, Level] = (0.0, "", "good")
        self._history = History(source.hand, live=source.live)
        self._lines: deque[LogLine] = deque(maxlen=_LOG_LINES)
        self._scale = Scale()
        self._view: View | None = None
        self._done: queue.SimpleQueue[tuple[str, Level]] = queue.SimpleQueue()
        """Message and severity for each completed command."""
        self._begun_s = time.monotonic()
        self._cpu_s = 0.0
        self._wall_minus_mono_ns = source.wall_minus_mono_ns
        self._records = _Records(self._lines)

    def compose(self) -> ComposeResult:
        """Yield the canvas."""
        yield self.canvas

    def on_mount(self) -> None:
        """Start drawing."""
        logging.getLogger().addHandler(self._records)
        self._begun_s = time.monotonic()
        self._cpu_s = time.thread_time()
        self._turn()

    def on_unmount(self) -> None:
        """End the recording, and remove the logging handler that adds warnings to the event log."""
        if self._source.recording is not None:
            self._source.stop_recording()  # the source then reports what the recording lacks
        logging.getLogger().removeHandler(self._records)

    @property
    def terminal_is_deaf(self) -> bool:
        """Whether the terminal has stopped accepting output."""
        return isinstance(self._driver, PatientDriver) and self._driver.deaf

    @property
    def view(self) -> View:
        """View shown on the screen; available after the first update."""
        assert self._view is not None
        return self._view

    # --- drawing

    def _turn(self) -> None:
        """Get the newest view, draw it, and schedule the next update."""
        now_s = time.monotonic()
        driver = self._driver
        gone = isinstance(driver, PatientDriver) and driver.gone
        late = self._seconds is not None and now_s - self._begun_s >= self._seconds
        try:
            self._look_at_source()
        except SkinError as error:
            self.failure = error
        if gone or late or self._over() or self.failure is not None:
            self.exit()
            return
        self._draw()
        cpu_s = time.thread_time()
        spent_s, self._cpu_s = cpu_s - self._cpu_s, cpu_s
        self.set_timer(min(SLOWEST_S, max(PERIOD_S, spent_s / SHARE)), self._turn)

    def _look_at_source(self) -> None:
        ending = self._source.over
        snapshot = self._source.snapshot()
        view = self._history.add(snapshot)
        self.faults.update(view, time.monotonic_ns(), ending=ending)
        for event in self._source.events():
            begins = event.what == "operational" and time.monotonic() - self._begun_s < _BEGIN_S
            if not begins:  # skip events for patches that become operational at start-up
                self._lines.append(log_line(event, self._wall_minus_mono_ns))
        self._settle_commands()
        if not self._paused:
            self._view = view
            self._scale.update(view.t_ns, view.deepest_m)

    def _draw(self) -> None:
        """Draw the view, unless the terminal is still receiving the previous update."""
        driver = self._driver
        if isinstance(driver, PatientDriver):
            if driver.busy:
                return
            if driver.torn:
                driver.torn = False
                self.screen.refresh()
        view, log = self._view, tuple(self._lines)
        paint = Paint(self._theme, self._ui(), self._scale.full_m)
        if view is not None:
            self.canvas.show(lambda width, height: screen(view, paint, log, width, height))

    def _ui(self) -> UiState:
        now_s = time.monotonic()
        until_s, message, level = self._message
        return UiState(
            title=self._source.title,
            selected=self._names[self._selected],
            elapsed_s=now_s - self._begun_s,
            zoomed=self._zoomed,
            paused=self._paused,
            arrows=self._arrows,
            over=self._source.over,
            commands=self._source.no_commands is None,
            recordable=self._source.no_recording is None,
            recording=self._source.recording,
            message=message if now_s < until_s else "",
            message_level=level,
        )

    def _say(self, text: str, level: Level = "good") -> None:
        self._message = time.monotonic() + _MESSAGE_S, text, level
        self._lines.append(LogLine(time_of_day(time.time_ns()), "", text, level))
        self._draw()

    # --- keys

    def action_leave(self) -> None:
        """Quit."""
        self.exit()

    def action_choose(self, step: int) -> None:
        """Select the next or the previous patch."""
        self._selected = (self._selected + step) % len(self._names)
        self._draw()

    def action_choose_number(self, number: int) -> None:
        """Select a patch by its number, counted from 1."""
        if number <= len(self._names):
            self._selected = number - 1
            self._draw()

    def action_zoom(self) -> None:
        """Switch between the selected patch alone and all patches."""
        self._zoomed = not self._zoomed
        self._draw()

    def action_unzoom(self) -> None:
        """Show all patches."""
        self._zoomed = False
        self._draw()

    def action_pause(self) -> None:
        """Freeze or unfreeze the display."""
        self._paused = not self._paused
        self._draw()

    def action_arrows(self) -> None:
        """Show or hide shear arrows on the maps."""
        self._arrows = not self._arrows
        self._draw()

    def action_help(self) -> None:
        """Show the keys."""
        self.push_screen(Dialog(HELP, question=False))

    def action_tare(self, everything: bool) -> None:
        """Ask for confirmation, then tare the selected patch or all patches."""
        names = self._names if everything else [self._names[self._selected]]
        felt = [
            f"{name} {1e6 * (self._view.patch(name).depth_m or 0.0):.0f} µm" for name in names if self._view
        ]
        text = f"Tare {'all patches' if everything else names[0]}?\n\n"
        text += f"The current reading becomes zero: {', '.join(felt)}.\nDo not touch the skin."
        done = "tared; the new baseline is in use"
        self._ask(text, "tare", lambda: self._command(names, "tare", self._source.tare, done))

    def action_reset(self) -> None:
        """Ask for confirmation, then reset the node of the selected patch."""
        names, done = [self._names[self._selected]], "reset; the host brings its node up again"
        text = f"Reset the node of {names[0]}?\n\nIt sends no data until the host has brought it up again."
        self._ask(text, "reset", lambda: self._command(names, "reset", self._source.reset_node, done))

    def _ask(self, text: str, verb: str, act: Callable[[], None]) -> None:
        """Ask for confirmation, then act; if the source accepts no commands, show the reason instead."""
        if (refusal := self._source.no_commands) is not None:
            self._say(refusal, "bad")
            return
        self.push_screen(
            Dialog(f"{text}\n\ny, enter: {verb}     any other key: cancel", question=True),
            lambda sure: act() if sure else None,
        )

    def _command(self, names: list[str], verb: str, act: Callable[[str], None], done: str) -> None:
        """Command patches on daemon threads, which do not delay the monitor's exit."""
        self._say(f"{', '.join(names)}: {verb} requested")

        def command(name: str) -> None:
            try:
                act(name)
            except SkinError as error:
                self._done.put((str(error), "bad"))
            else:
                self._done.put((f"{name}: {done}", "good"))

        for name in names:
            threading.Thread(target=command, args=(name,), name=f"{verb} {name}", daemon=True).start()

    def _settle_commands(self) -> None:
        """Show the results of completed commands."""
        while not self._done.empty():
            self._say(*self._done.get())

    async def action_record(self) -> None:
        """Start or stop a recording."""
        source = self._source
        if (refusal := source.no_recording) is not None:
            self._say(refusal, "bad")
            return
        try:
            if source.recording is None:
                path = await asyncio.to_thread(source.record, self._folder)
                self._say(f"recording to {path}")
            else:
                ended = await asyncio.to_thread(source.stop_recording)
                lost = f", {ended.dropped} lost" if ended.dropped else ""
                why = f": {ended.failure}" if ended.failure else ""
                level: Level = "bad" if lost or why else "good"
                self._say(f"{ended.frames} frames{lost}{why} in {ended.path}", level)
        except SkinError as error:
            self._say(str(error), "bad")


class _Records(logging.Handler):
    """Logging handler that adds warnings to the event log, because printing them would corrupt the screen."""

    def __init__(self, lines: deque[LogLine]) -> None:
        super().__init__(logging.WARNING)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        if record.name.startswith("skinnode") and record.name not in _SHOWN_AS_EVENTS:
            text = " ".join(record.getMessage().split())
            self._lines.append(LogLine(time_of_day(int(record.created * 1e9)), "", text, "note"))


def terminal_colours(environment: Mapping[str, str]) -> Colours:
    """Return the terminal's colour support, which rich derives from environment variables."""
    from rich.console import Console

    if environment.get("NO_COLOR"):
        return "none"
    system = Console(force_terminal=True, _environ=environment).color_system
    if system in ("truecolor", "256"):
        return "rgb"
    return "none" if system is None else "ansi"
