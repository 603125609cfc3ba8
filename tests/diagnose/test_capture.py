"""Scans as the doctor takes them off a bus."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.diagnose.scan_capture import ScanCapture
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import Frame

MS = 1_000_000


def frame(t_ms: float, can_id: int, data: str) -> Frame:
    return Frame(can_id, bytes.fromhex(data), round(t_ms * MS))


@pytest.mark.parametrize("counted", [True, False])
def test_a_scan_that_ends_after_the_next_sync_is_that_of_the_sync_before(counted: bool) -> None:
    """As on a bus that many patches share."""
    capture = ScanCapture()
    capture.add(5, PatchProfile(1, 6, 1, 1), 240 if counted else 0, 0.080)
    capture.on_frames([frame(0, 0x285, "01 00 02 00 00 00 00 00")])  # the end of a scan under way
    capture.on_frames([frame(160, 0x080, "02" if counted else "")])
    for scan in range(2, 6):
        t_ms, number = 80 * scan, f"{scan:02x}"
        capture.on_frames([frame(t_ms + 30, 0x185, f"00 {number} 10 00 10 00 10 00")])
        capture.on_frames([frame(t_ms + 80, 0x080, f"{scan + 1:02x}" if counted else "")])
        capture.on_frames([frame(t_ms + 82, 0x185, f"01 {number} 10 00 10 00 10 00")])
        capture.on_frames([frame(t_ms + 83, 0x285, f"{number} 00 02 00 00 00 00 00")])
    facts = capture.facts(5, CodeScale(16), 3e-6)
    assert facts is not None
    assert facts.complete.all()
    np.testing.assert_allclose(1e3 * facts.latency_s, [83.0] * 4)
