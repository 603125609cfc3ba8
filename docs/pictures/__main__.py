"""Draw the pictures of the guides.

    python docs/pictures              draws all of them into docs/img/
    python docs/pictures patch ros2   draws these two

Numbers in the pictures are results of the simulated hand, its host and its solver; nothing is measured on a
real patch. The screens need Chromium (apt-get install chromium).
"""

from __future__ import annotations

import sys

import flows
import patch
import scans
import screens
import streams

PICTURES = {**patch.PICTURES, **flows.PICTURES, **scans.PICTURES, **screens.PICTURES, **streams.PICTURES}


def main() -> None:
    names = sys.argv[1:] or list(PICTURES)
    for name in names:
        if name not in PICTURES:
            raise SystemExit(f"got {name}, allowed: {', '.join(PICTURES)}")
        PICTURES[name]()


if __name__ == "__main__":
    main()
