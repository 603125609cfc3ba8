"""Create the documentation's screenshot of `skinnode view --web` with Debian's Chromium.

    python docs/view_picture.py          writes docs/img/view.png

Requires the packages rerun-sdk (sh install.sh view) and playwright (pip), and the program chromium
(apt-get install chromium). The script records a simulated hand with six patches until all are pressed. Then
the script shows the recording with `skinnode view --web` and opens the page in a headless browser. The script
uses a recording because a browser without a graphics card needs about a second per frame on all cores of a
small computer; a hand running at the same time would lose scans. At the end, the script prints the requests
that the page tried to send to other computers.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from figures import shrink
from playwright.sync_api import Route, sync_playwright

from skinnode.demo.hand import demo_hand
from skinnode.host import Host
from skinnode.record import Recorder
from vcan_sim.fleet import Fleet

PICTURE: Final = Path(__file__).with_name("img") / "view.png"
CHROMIUM: Final = "/usr/bin/chromium"
OPTIONS: Final = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
SIZE: Final = {"width": 1400, "height": 860}
PATIENCE_S: Final = 120.0
SHOWN_S: Final = 45.0
"""Delay before the screenshot, s."""
PATCHES: Final = 6
PRESSED_N: Final = 1.5
LONGEST_S: Final = 40.0


def record(path: Path) -> None:
    """Record a simulated hand until all its patches are pressed."""
    hand = demo_hand(PATCHES, seed=3)
    solver = hand.solver.model_copy(update={"method": "posterior"})
    hand = hand.model_copy(update={"name": "simulated hand", "solver": solver})
    with Fleet(hand), Recorder(hand, path) as recorder, Host.from_config(hand, tap=recorder) as host:
        end_s = time.monotonic() + LONGEST_S
        while time.monotonic() < end_s:
            time.sleep(0.02)
            fields = [host.latest(patch.name) for patch in hand.patches]
            if all(each and each.contacts and each.contacts[0].normal_force_n > PRESSED_N for each in fields):
                return


def picture_of(url: str, file: Path) -> list[str]:
    """Write a screenshot of the page and return the requests it tried to send to other computers."""
    elsewhere: list[str] = []

    def watch(route: Route) -> None:
        address = route.request.url
        if re.match(r"(https?://127\.0\.0\.1:\d+/|data:|blob:)", address):
            route.continue_()
        else:
            elsewhere.append(address)
            route.abort()

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        page = browser.new_page(viewport=SIZE)
        page.route(re.compile(".*"), watch)
        page.goto(f"{url}?renderer=webgl")
        page.wait_for_selector("canvas.visible", timeout=1e3 * PATIENCE_S)
        time.sleep(SHOWN_S)
        page.screenshot(path=str(file), timeout=1e3 * PATIENCE_S)
        browser.close()
    return elsewhere


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder, "hand.log")
        record(recording)
        command = [sys.executable, "-c", "from skinnode.cli.main import main; main()", "view", "--web"]
        shown = subprocess.Popen(
            [*command, "--replay", str(recording), *sys.argv[1:]],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert shown.stdout is not None
            found = re.search(r"http://\S+", shown.stdout.readline())
            if found is None:
                raise SystemExit("skinnode view did not start")
            shown.stdout.readline()  # the line that reports the end of the recording
            elsewhere = picture_of(found.group(), PICTURE)
            shrink(PICTURE, PICTURE)
        finally:
            shown.terminate()
            print(shown.communicate()[0])
    print(
        f"{PICTURE}: {PICTURE.stat().st_size // 1000} kB; requests to other computers: {elsewhere or 'none'}"
    )


if __name__ == "__main__":
    main()
