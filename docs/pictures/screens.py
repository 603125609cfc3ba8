"""Screenshots of reports, taken with Chromium: what the doctor and the conformance test write."""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from style import FOLDER, shrink

from skinnode.cli.main import main
from skinnode.config import load_hand
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

HAND = """
name = "example hand"
[[buses]]
name = "can0"
interface = "virtual"
channel = "can0"
[sync]
period_ms = 500
[simulation]
depth = 0.0
converter_noise = 3e-6
"""
PATCHES = ("thumb", "index", "middle", "palm")
FAULTS = {
    "palm": Faults(open_upper=3),
    "index": Faults(noisy_lower=4),
    "thumb": Faults(unplugged=True),
}
"""Faults of the second example in docs/faults.md."""


@contextlib.contextmanager
def hand_file() -> Iterator[Path]:
    """A hand on a bus of this process."""
    text = HAND + "".join(
        f'[[patches]]\nname = "{name}"\nnode_id = {number}\ntolerances = "exact"\nrelative_noise = 3e-6\n'
        "layout = { upper_wires = 6, upper_electrodes = 6 }\n"
        for number, name in enumerate(PATCHES, start=11)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "hand.toml")
        path.write_text(text, encoding="utf-8")
        yield path


def screenshot(page: Path, name: str, width: int, height: int) -> None:
    """Write ``docs/img/NAME.png``."""
    picture = FOLDER / f"{name}.png"
    subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
         "--force-device-scale-factor=1", f"--window-size={width},{height}", f"--screenshot={picture}",
         page.as_uri()],
        check=True, capture_output=True, timeout=180,
    )  # fmt: skip
    shrink(picture)


def run(*arguments: str) -> None:
    with contextlib.suppress(SystemExit):
        main(list(arguments))


def doctor() -> None:
    """Report of the doctor on a hand with three faults."""
    with hand_file() as path:
        with Fleet(load_hand(path)) as fleet:
            for patch, faults in FAULTS.items():
                fleet.inject(faults, patch)
            run("doctor", str(path), "--active", "--html", str(path.with_name("report.html")))
        screenshot(path.with_name("report.html"), "doctor", 1000, 560)


def conformance() -> None:
    """Report of a conformance test."""
    with hand_file() as path:
        with Fleet(load_hand(path)):
            bus = ["--interface", "virtual", "--channel", "can0"]
            only = ["--only", "EDS,OD,SDO-01,SDO-02,SDO-03,SDO-04,SDO-05"]
            run("conformance", "--node-id", "14", *bus, *only, "--html", str(path.with_name("report.html")))
        screenshot(path.with_name("report.html"), "conformance", 1000, 900)


PICTURES: dict[str, Any] = {"doctor": doctor, "conformance": conformance}
