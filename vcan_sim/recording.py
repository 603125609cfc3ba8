"""Recording of a simulated run in a folder: bus trace, ground truth, faults and scene.

===============  =======================================================================================
file             content
===============  =======================================================================================
trace.log        every frame, in ``candump -L`` format, with the name of the bus as the channel
truth.npz        for each patch and scan: ``PATCH time_ns`` (Unix time), ``PATCH device_time_us`` as in the
                 scan's summary, ``PATCH displacement_m`` (scans, U, N, 3) and, if there is a scene,
                 ``PATCH wrench`` (scans, 6) in N and N m
faults.jsonl     the start and end of every fault
scene.json       the scene, if there is one
===============  =======================================================================================
"""

from __future__ import annotations

import contextlib
import json
import re
import threading
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TextIO

import numpy as np

from skinnode.errors import ConfigError
from skinnode.process import clock
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import SceneConfig
from vcan_sim.trace import Listener

TRACE: Final = "trace.log"
TRUTH: Final = "truth.npz"
FAULTS: Final = "faults.jsonl"
SCENE: Final = "scene.json"


def channels_of(buses: Iterable[str]) -> dict[str, str]:
    """Return each bus's channel in a trace: the bus name, with spaces replaced by underscores.

    No two buses have the same channel.
    """
    names = list(buses)
    channels = {name: name for name in names if not re.search(r"\s", name)}
    for name in names:
        channel = re.sub(r"\s", "_", name)
        while name not in channels and channel in channels.values():
            channel += "_"
        channels.setdefault(name, channel)
    return channels


class Recording:
    """Recording of a fleet during a ``with`` block, which must enclose the fleet's ``with`` block.

    Call :meth:`poll` at least once a minute, because patches store a limited number of readings. If an
    exception ends the block before any frame or reading has been recorded, the folder is removed.

    Args:
        folder: New folder for the files.
        fleet: Fleet to record.
        scene: Scene that the fleet plays; None for random strokes.

    Raises:
        ConfigError: On entry, if the folder already exists or cannot be created.
        BusError: On entry, if a bus cannot be opened. The folder is then removed.
        OSError: From any method, if a file cannot be written.
    """

    def __init__(self, folder: Path, fleet: Fleet, scene: SceneConfig | None = None) -> None:
        self._folder, self._fleet, self._scene = folder, fleet, scene
        self._open = ExitStack()
        self._writing = threading.Lock()
        self._trace: TextIO | None = None
        self._failure: OSError | None = None
        self._faults_written = 0
        self._polled_ns = dict.fromkeys(fleet.patches, -1)
        self._truth: dict[str, list[Any]] = {}

    def __enter__(self) -> Self:
        try:
            self._folder.mkdir(parents=True)
        except OSError as error:
            allowed = f"a new folder that can be created ({error.strerror})"
            raise ConfigError("--record", str(self._folder), allowed) from None
        try:
            self._begin()
        except BaseException:  # nothing has been recorded, and a further attempt needs a new folder
            self._discard()
            raise
        return self

    def _begin(self) -> None:
        """Write the scene, and start recording the frames on all buses."""
        if self._scene is not None:
            text = self._scene.model_dump_json(indent=1)
            (self._folder / SCENE).write_text(text, encoding="utf-8")
        with ExitStack() as opened:
            self._trace = opened.enter_context((self._folder / TRACE).open("w", encoding="ascii"))
            buses = self._fleet.hand.buses
            channels = channels_of(bus.name for bus in buses)
            for bus in buses:
                opened.enter_context(Listener(bus, self._write, channels[bus.name]))
            self.poll()
            self._open = opened.pop_all()

    def _is_empty(self) -> bool:
        """Return whether the recording is empty (no frames, no readings) because the fleet did not start."""
        readings = any(patch.read_times_ns() for patch in self._fleet.patches.values())
        return not readings and (self._folder / TRACE).stat().st_size == 0

    def _discard(self) -> None:
        with contextlib.suppress(OSError):
            for name in (SCENE, TRACE, FAULTS):
                (self._folder / name).unlink(missing_ok=True)
            self._folder.rmdir()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
        if error is not None and self._is_empty():  # as if it had not begun
            self._discard()
            return
        self.poll()
        arrays: dict[str, Any] = {name: np.array(values) for name, values in self._truth.items()}
        np.savez_compressed(self._folder / TRUTH, **arrays)

    def poll(self) -> None:
        """Record the ground truth of all scans and all fault changes since the last call."""
        if self._failure is not None:
            raise self._failure
        wall_ns = clock.time_ns() - clock.monotonic_ns()
        for name in self._fleet.patches:
            self._add_truth(name, wall_ns)
        log = self._fleet.faults.log
        with (self._folder / FAULTS).open("a", encoding="utf-8") as file:
            for event in log[self._faults_written :]:
                scene_s = self._fleet.scene_s(event.time_ns - wall_ns)
                line = {
                    "time_s": event.time_ns * 1e-9,
                    "scene_s": None if scene_s is None else round(scene_s, 6),
                    "place": event.place,
                    "fault": event.fault,
                    "value": event.value,
                    "on": event.on,
                }
                file.write(json.dumps(line | ({"refused": event.refused} if event.refused else {})) + "\n")
        self._faults_written = len(log)
        if self._trace is not None and not self._trace.closed:
            with self._writing:
                self._trace.flush()

    def _add_truth(self, name: str, wall_ns: int) -> None:
        patch = self._fleet.patches[name]
        new_ns = [t_ns for t_ns in patch.read_times_ns() if t_ns > self._polled_ns[name]]
        for t_ns in new_ns:
            self._keep(f"{name} time_ns", np.int64(t_ns + wall_ns))
            self._keep(f"{name} device_time_us", np.uint32(t_ns // 1000 & 0xFFFF_FFFF))
            self._keep(f"{name} displacement_m", patch.displacement_m(t_ns).astype(np.float32))
            if self._scene is not None:
                self._keep(f"{name} wrench", self._fleet.truth_at(name, t_ns).wrench)
        self._polled_ns[name] = max(new_ns, default=self._polled_ns[name])

    def _keep(self, key: str, value: Any) -> None:
        self._truth.setdefault(key, []).append(value)

    def _write(self, line: str) -> None:
        assert self._trace is not None
        try:
            with self._writing:
                self._trace.write(line)
        except OSError as error:  # poll() raises it
            self._failure = error
