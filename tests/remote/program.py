"""Program: connects to a hand, and answers each line on standard input with its counters.

program.py NAME PORT [ROUTER]
"""

from __future__ import annotations

import dataclasses
import json
import sys

import skinnode as sk

router = sys.argv[3] if len(sys.argv) > 3 else None
with sk.connect(sys.argv[1], port=int(sys.argv[2]), router=router, timeout_s=60.0) as hand:
    print("up", flush=True)
    for _ in sys.stdin:
        print(json.dumps({**dataclasses.asdict(hand.stats()), "away": hand.away}), flush=True)
