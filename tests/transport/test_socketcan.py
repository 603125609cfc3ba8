"""What only a kernel's CAN socket has: drop counter, kernel times, hardware times."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import time
from pathlib import Path

import pytest

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.transport import CanPort, Frame
from skinnode.transport.hardware_time import HardwareClock
from skinnode.transport.socketcan import set_link_bitrate

VCAN = BusConfig(name="can7", interface="socketcan", channel="vcan0")
MS = 1_000_000


@pytest.mark.vcan
def test_what_the_kernel_drops_is_counted_exactly(monkeypatch) -> None:
    with CanPort(VCAN) as ours, CanPort(VCAN) as theirs:
        theirs._bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        for number in range(500):
            ours.send(number, b"12345678")
        frames: list[Frame] = []
        while batch := theirs.recv_batch(0.1):
            frames += batch
        assert 0 < len(frames) < 500
        assert [frame.can_id for frame in frames] == list(range(len(frames)))  # the newest were dropped
        ours.send(0x7FF, b"")  # the kernel tells with the next frame that it has room for
        last = theirs.recv(1.0)
        assert last is not None
        assert last.can_id == 0x7FF
        assert theirs.received + theirs.dropped == 501


@pytest.mark.vcan
def test_a_batch_has_every_frame_that_waits_in_order_with_its_own_time() -> None:
    with CanPort(VCAN) as ours, CanPort(VCAN) as theirs:
        time.sleep(0.1)  # the kernel starts to stamp packets a moment after the first socket asked for it
        for number in range(20):
            ours.send(number, bytes([number]))
            time.sleep(0.012)
        batch = theirs.recv_batch(1.0)
        assert [(frame.can_id, frame.data) for frame in batch] == [(i, bytes([i])) for i in range(20)]
        gaps_ns = [b.t_ns - a.t_ns for a, b in itertools.pairwise(batch)]
        assert min(gaps_ns) >= 10 * MS
        assert theirs.recv_batch(0.0) == []
        ours.send(1, b"")
        ours.send(2, b"")
        assert [len(theirs.recv_batch(1.0, 1)) for _ in range(2)] == [1, 1]


@pytest.mark.vcan
def test_a_step_of_the_wall_clock_dates_no_frame_into_the_future(monkeypatch) -> None:
    real_ns = time.time_ns
    with CanPort(VCAN) as ours, CanPort(VCAN) as theirs:
        for step_s in (-3600, 3600):
            monkeypatch.setattr(time, "time_ns", lambda step_s=step_s: real_ns() + step_s * 10**9)
            ours.send(1, b"")
            before_ns = time.monotonic_ns()
            frame = theirs.recv(1.0)
            assert frame is not None
            assert before_ns <= frame.t_ns <= time.monotonic_ns()


@pytest.mark.vcan
def test_a_link_without_a_bit_rate_says_so_and_is_up_again() -> None:
    with CanPort(VCAN) as ours, CanPort(VCAN) as theirs:
        with pytest.raises(BusError, match=r"channel 'vcan0': does not accept 250000 bit/s \(.+\)$"):
            ours.set_bitrate(250_000)
        assert ours.config.bitrate_bps == 1_000_000
        theirs.reopen()  # its socket heard that the link went down
        ours.send(1, b"here")
        frame = theirs.recv(1.0)
        assert frame is not None
        assert frame.data == b"here"


IP = """\
#!/bin/sh
echo "$*" >> "$0.calls"
case "$*" in
*show*) echo '[{"flags": ["NOARP", "UP"], "linkinfo": {"info_data": {"bittiming": {"bitrate": 500000}}}}]' ;;
*) echo "RTNETLINK answers: Operation not permitted" >&2; exit 2 ;;
esac
"""


def test_a_bit_rate_that_the_link_has_needs_no_privileges_and_another_one_is_refused_with_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a board that starts with a stored bit rate: at another one, it would disturb the bus."""
    program = tmp_path / "ip"
    program.write_text(IP)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    config = BusConfig(name="can7", interface="socketcan", channel="can3", bitrate_bps=500_000)
    set_link_bitrate(config)
    assert "set" not in Path(f"{program}.calls").read_text()
    with pytest.raises(BusError) as refused:
        set_link_bitrate(config.model_copy(update={"bitrate_bps": 250_000}))
    assert str(refused.value) == (
        "can7: interface 'socketcan', channel 'can3': does not accept 250000 bit/s (RTNETLINK answers: "
        "Operation not permitted); as root, run: ip link set can3 down && ip link set can3 up type can "
        "bitrate 250000"
    )


def test_hardware_stamps_keep_a_frames_time_however_late_the_kernel_was() -> None:
    """A controller whose clock is 100 s off and 50 ppm fast, frames every 10 ms, the kernel 0 to 5 ms late:
    but for the first frames, times are right to what the clock drifts between two prompt ones."""
    delay = HardwareClock()
    late_ns = [(7 * i) % 26 * MS // 5 for i in range(1000)]
    errors_ns = []
    for i, late in enumerate(late_ns):
        true_ns = i * 10 * MS
        hardware_ns = 100_000 * MS + true_ns + true_ns * 50 // 1_000_000
        errors_ns.append(delay.arrival_ns(hardware_ns, true_ns + late) - true_ns)
    assert errors_ns[0] == 0
    assert min(errors_ns) >= -MS // 10
    assert max(errors_ns[30:]) <= MS // 10


def test_a_controller_whose_clock_starts_anew_is_followed() -> None:
    delay = HardwareClock()
    assert delay.arrival_ns(60_000 * MS, 1_000 * MS) == 1_000 * MS
    assert delay.arrival_ns(0, 1_010 * MS) == 1_010 * MS
    assert delay.arrival_ns(5 * MS, 1_016 * MS) == pytest.approx(1_015 * MS, abs=2_000)


@pytest.mark.vcan
def test_a_link_that_goes_down_is_told_to_the_reader_though_a_sender_heard_it_first() -> None:
    with CanPort(VCAN) as ours, CanPort(VCAN) as theirs:
        theirs.send(1, b"before")
        subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
        try:
            with pytest.raises(BusError, match="0x002 not sent"):
                ours.send(2, b"")
            assert [frame.data for frame in ours.recv_batch(0.05)] == [b"before"]
            with pytest.raises(BusError, match="cannot receive"):
                ours.recv_batch(0.05)
        finally:
            subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
