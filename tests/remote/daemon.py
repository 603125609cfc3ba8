"""Program: publishes a simulated hand until its standard input ends.

    daemon.py '{"name": …, "port": …, "patches": …, "router": …, "commands": …}'

``pitch_mm`` changes the electrodes, ``version`` the versions of the messages that the daemon states, and
``behind_s`` sets its clock back.
Each line on standard input is a question about the host; see :func:`answer`.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import skinnode as sk
from skinnode.config import parse_hand
from skinnode.errors import SkinError
from skinnode.messages.definitions import FIELD
from skinnode.process import clock
from skinnode.remote import Publication, SessionOptions, description
from vcan_sim.fleet import Fleet

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


def hand_of(name: str, patches: int, period_ms: int, pitch_mm: float) -> Any:
    layout = {**SMALL, "pitch_m": pitch_mm * 1e-3}
    listed = [
        {"name": f"p{i}", "node_id": 4 + i, "layout": layout, "tolerances": "exact"} for i in range(patches)
    ]
    return parse_hand(
        {
            "name": name,
            "buses": [{"name": "can0", "interface": "virtual", "channel": "daemon"}],
            "patches": listed,
            "sync": {"period_ms": period_ms},
            "solver": {"method": "posterior"},
        }
    )


def answer(line: str, host: sk.Host, publication: Publication) -> Any:
    match line:
        case "stats":
            stats = publication.stats()
            solved = {name: each.solved for name, each in host.stats().patches.items()}
            return {"published": stats.published, "dropped": stats.dropped, "solved": solved}
        case "baselines":
            return {name: node.baselines for name, node in host.stats().nodes.items()}
        case "boot_ups":
            return {patch.name: host.health(patch.name).boot_ups for patch in host.hand.patches}
    raise ValueError(line)


def main(options: dict[str, Any]) -> int:
    hand = hand_of(
        options.get("name", "hand"),
        options.get("patches", 2),
        options.get("period_ms", 50),
        options.get("pitch_mm", 4.0),
    )
    behind_ns = int(options.get("behind_s", 0) * 1e9)
    clock.time_ns = lambda: time.time_ns() - behind_ns  # type: ignore[assignment]
    description._VERSIONS.update({FIELD: options.get("version", description._VERSIONS[FIELD])})
    config = options.get("config")
    how = SessionOptions(
        options.get("router"),
        options.get("listen"),
        None if config is None else Path(config),
        options["port"],
    )
    try:
        with (
            Fleet(hand),
            sk.Host.from_config(hand) as host,
            sk.publish(host, how, commands=options.get("commands", False)) as publication,
        ):
            print("up", flush=True)
            for line in sys.stdin:
                print(json.dumps(answer(line.strip(), host, publication)), flush=True)
    except SkinError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
