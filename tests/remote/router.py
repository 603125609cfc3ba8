"""Program: a Zenoh router on an endpoint, until its standard input ends.

router.py '{"listen": …}'
"""

from __future__ import annotations

import json
import sys

import zenoh

options = json.loads(sys.argv[1])
config = zenoh.Config.from_file(options["config"]) if "config" in options else zenoh.Config()
for key, value in (
    ("mode", "router"),
    ("listen/endpoints", [options["listen"]]),
    ("scouting/multicast/enabled", False),
):
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("up", flush=True)
    sys.stdin.read()
