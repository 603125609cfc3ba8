"""Facts as a healthy hand has them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from skinnode.canopen import indices as od
from skinnode.diagnose.discovery import FoundNode
from skinnode.diagnose.facts import BusFacts, PatchFacts, ScanFacts
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import AssemblerStats

NO_LOSS = ScanAssembler(PatchProfile(4, 12, 4, 4)).stats
STEP = 1.0 / ((1 << 16) - 4)
NOISE = 1e-4  # a noise that shows in 16-bit codes


def scans_of(ratio: np.ndarray, **changes: Any) -> ScanFacts:
    """(T, U, K) R/R0 every 80 ms without any loss."""
    count, *shape = ratio.shape
    zero = np.zeros(shape, dtype=np.int64)
    facts: dict[str, Any] = {
        "ratio": ratio,
        "n_open": zero,
        "n_short": zero,
        "n_over": zero,
        "t_s": 0.08 * np.arange(count),
        "latency_s": np.full(count, 0.06),
        "device_us": 80_000 * np.arange(count, dtype=np.int64),
        "complete": np.ones(count, dtype=np.bool_),
        "step": STEP,
        "stated_noise": NOISE,
        "stats": NO_LOSS,
    }
    return ScanFacts(**(facts | changes))


def quiet_ratio(seed: int = 1) -> np.ndarray:
    """50 scans of a patch at rest."""
    noise = np.random.default_rng(seed).standard_normal((50, 4, 12))
    return np.asarray(np.rint((1.0 + NOISE * noise) / STEP) * STEP)


def node(node_id: int = 5, **changes: Any) -> FoundNode:
    """A patch of ours that runs."""
    facts: dict[str, Any] = {
        "node_id": node_id,
        "answers": True,
        "state": "operational",
        "state_known_by": "heartbeat",
        "name": "skinnode patch",
        "device_type": 0,
        "error_register": 0,
        "vendor_id": od.VENDOR_ID,
        "product_code": od.PRODUCT_CODE,
        "revision": od.REVISION_NUMBER,
        "serial": 7,
        "heartbeat_ms": 250,
        "boot_ups": 0,
        "duplicate": "",
    }
    return FoundNode(**(facts | changes))


def bus_of(*patches: PatchFacts, **changes: Any) -> BusFacts:
    """A bus that is well and on which SYNC comes every 80 ms."""
    facts: dict[str, Any] = {
        "name": "can0",
        "interface": "socketcan",
        "channel": "can0",
        "bitrate_bps": 1_000_000,
        "seconds": 6.0,
        "frames": 5000,
        "load": 0.4,
        "period_s": 0.08,
        "sync_s": 0.08 * np.arange(60),
        "heartbeat_ms": 250,
        "patches": patches,
    }
    return BusFacts(**(facts | changes))


def stats(**counts: int) -> AssemblerStats:
    return replace(NO_LOSS, **counts)
