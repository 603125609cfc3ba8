"""The sums of a host's counters: every counter is in one, and what does not add up is named."""

from __future__ import annotations

from dataclasses import fields
from types import SimpleNamespace

import pytest

from skinnode.config import BusConfig
from skinnode.host.accounting import discrepancies
from skinnode.host.dispatcher import Dispatcher
from skinnode.host.patch_stream import StreamStats
from skinnode.transport import Frame

BUS = {"read": 31, "received": 20, "ignored": 5, "error_frames": 3, "dropped": 2, "waiting": 1}
ASSEMBLED = {
    "chunks_accepted": 3,
    "summaries_accepted": 2,
    "duplicates": 1,
    "conflicts": 1,
    "late": 1,
    "bad_length": 2,
    "bad_index": 1,
    "bad_counter": 1,
    "bad_form": 1,
    "scans_complete": 5,
    "scans_torn": 2,
    "scans_unchecked": 1,
}
STREAM = {"frames": 13, "offered": 5, "withheld": 2, "partial": 1, "solved": 4, "failed": 0, "skipped": 1}
SHARES = ["withheld", "partial", "solved", "failed", "skipped"]


def found(bus: dict[str, int], stream: dict[str, int], assembled: dict[str, int]) -> list[str]:
    stream_stats = SimpleNamespace(**STREAM | stream, assembler=SimpleNamespace(**ASSEMBLED | assembled))
    bus_stats = SimpleNamespace(**{"foreign": 4, "malformed": 3} | BUS | bus)
    return discrepancies(SimpleNamespace(buses={"can0": bus_stats}, patches={"palm": stream_stats}))  # type: ignore[arg-type]


def test_sums_that_agree() -> None:
    assert found({}, {}, {}) == []


@pytest.mark.parametrize("counter", BUS)
@pytest.mark.parametrize("change", [-1, 1])
def test_each_counter_of_a_bus_is_in_its_sum(counter: str, change: int) -> None:
    got, must = 31 + change * (counter == "read"), 31 + change * (counter != "read")
    line = f"can0: frames read: got {got}, must equal the {must} counted"
    assert found({counter: BUS[counter] + change}, {}, {}) == [line]


@pytest.mark.parametrize("counter", ASSEMBLED)
def test_each_counter_of_an_assembler_is_in_its_sum(counter: str) -> None:
    of_scans = counter.startswith("scans")
    name, got = ("scans offered or withheld", 8) if of_scans else ("frames", 13)
    must = f"{got + 1} {'assembled' if of_scans else 'counted'}"
    lines = found({"malformed": 4}, {}, {counter: ASSEMBLED[counter] + 1})
    assert lines == [f"palm: {name}: got {got}, must equal the {must}"]


@pytest.mark.parametrize(
    "counter", [name for name in SHARES if name in {f.name for f in fields(StreamStats)}]
)
def test_each_counter_of_a_patch_is_in_its_sum(counter: str) -> None:
    (line,) = found({}, {counter: STREAM[counter] + 1}, {})
    assert line.startswith("palm: scans offered")


def test_sums_over_all_buses_and_patches() -> None:
    assert found({"foreign": 7}, {}, {}) == []
    assert found({"foreign": 8}, {}, {}) == ["got 13 PDOs, must be at most the 12 frames that were handled"]
    line = "got 3 PDOs of wrong length or format, must be at most the 2 malformed frames"
    assert found({"malformed": 2}, {}, {}) == [line]


def test_load_of_a_bus_is_that_of_its_last_second() -> None:
    """Frames of 53 bits (timing tests: identifier 0, no data) at 1 Mbit/s; measured ten times a second."""
    dispatcher = Dispatcher(BusConfig(name="can0", channel="load"), {}, 0)
    assert (dispatcher.count().bits, dispatcher.count().load) == (0, 0.0)
    dispatcher.dispatch([Frame(0, b"", 1)] * 1000)
    dispatcher.measure(99_999_999)
    assert dispatcher.count().bits == 0  # not due yet
    for tenth in range(1, 11):
        dispatcher.measure(tenth * 100_000_000)
        assert dispatcher.count().load == pytest.approx(0.053 / (0.1 * tenth))
    assert dispatcher.count().bits == 53_000
    dispatcher.measure(1_100_000_000)
    assert dispatcher.count().load == 0.0
