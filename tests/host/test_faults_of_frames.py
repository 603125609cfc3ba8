"""Frames that go astray between a node and its host: counted on both sides alike, and never a mixed scan.

Every reading of the simulated patches has its own resistance, the same for all wire pairs, so a scan that
holds values of two readings shows itself whatever else went wrong.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from skinnode.config import HandConfig
from skinnode.host import Condition, Host
from skinnode.host.accounting import discrepancies, losses_of_stream
from skinnode.host.host import HostStats
from skinnode.host.patch_stream import StreamStats
from skinnode.protocol.assembler import AssemblerStats
from vcan_sim.faults import NO_FAULTS, Faults, Injected
from vcan_sim.fleet import Fleet

from .conftest import eventually
from .tagged import Tags

SCANS = 40
"""How many scans suffer; the pace is one in 25 ms."""


class Hand:
    """A hand that runs, with tagged scans."""

    def __init__(self, fleet: Fleet, host: Host, tags: Tags) -> None:
        self.fleet, self.host, self.tags = fleet, host, tags

    def stream(self, patch: str = "p0") -> StreamStats:
        return self.host.stats().patches[patch]

    def scans(self, more: int, patch: str = "p0") -> None:
        """Wait until this many more scans were taken by the node and let through by the host."""
        taken, offered = self.tags.taken(patch), self.stream(patch).offered
        assert eventually(
            lambda: self.tags.taken(patch) >= taken + more and self.stream(patch).offered > offered
        )

    def skipped(self, patch: str = "p0") -> tuple[AssemblerStats, int]:
        """Return what the host counted, and the scans that the node skipped on a machine that is too busy.

        Both at a moment when the host has received a scan after the last one that was skipped."""
        for _ in range(100):
            skipped = overruns(self.fleet, patch)
            self.scans(1, patch)
            counted = self.stream(patch).assembler
            if overruns(self.fleet, patch) == skipped:
                return counted, skipped
        raise AssertionError(f"{patch} skips scans all the time")

    def suffer(self, faults: Faults, scans: int = SCANS) -> Injected:
        """Let p0 suffer, and be well again for long enough that everything has been counted."""
        self.scans(5)
        self.fleet.inject(faults, "p0")
        self.scans(scans)
        self.fleet.inject(NO_FAULTS, "p0")
        self.scans(8)
        return self.fleet.injected("p0")


@pytest.fixture
def running(make_hand: Callable[..., HandConfig], monkeypatch: pytest.MonkeyPatch) -> Iterator[Hand]:
    hand = make_hand()
    tags = Tags(monkeypatch)
    with Fleet(hand, wire_up=tags.wire_up) as fleet:
        with Host.from_config(hand) as host:
            running = Hand(fleet, host, tags)
            running.scans(3)
            yield running
            assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)
            counted, skipped = running.skipped("p1")
            assert counted.scans_missed == skipped  # the neighbour suffers nothing
        assert_sums(host.stats(), fleet, tags)


def assert_sums(stats: HostStats, fleet: Fleet, tags: Tags) -> None:
    """At the end: what was sent is what was received, what was received is what was published, and nothing
    that was published is mixed."""
    assert discrepancies(stats) == []
    for name, stream in stats.patches.items():
        assert stream.frames == fleet.injected(name).pdos
    assert stats.patches["p1"].assembler.scans_torn == 0  # the neighbour suffers nothing
    assert tags.mixed == []
    assert tags.seen > 0


def overruns(fleet: Fleet, patch: str) -> int:
    """Scans that a node skipped by itself, because this machine was too busy for it."""
    return next(report.overruns for report in fleet.report() if report.patch == patch)


def test_lost_chunks(running: Hand) -> None:
    injected = running.suffer(Faults(lost=0.05))
    counted, skipped = running.skipped()
    assert injected.lost > 10
    assert counted.chunks_lost == injected.lost
    assert counted.scans_torn == injected.scans_spoilt
    assert counted.duplicates == counted.late == counted.conflicts == 0
    assert counted.scans_missed == skipped


@pytest.mark.long
def test_duplicated_chunks(running: Hand) -> None:
    injected = running.suffer(Faults(duplicated=0.05))
    counted = running.stream().assembler
    assert injected.duplicated > 10
    assert counted.duplicates == injected.duplicated
    assert counted.scans_torn == counted.chunks_lost == counted.conflicts == 0


@pytest.mark.long
def test_reordered_chunks(running: Hand) -> None:
    injected = running.suffer(Faults(reordered=0.1))
    counted = running.stream().assembler
    assert injected.reordered > 20
    assert counted.scans_torn == counted.chunks_lost == counted.late == counted.duplicates == 0


def test_late_chunks(running: Hand) -> None:
    injected = running.suffer(Faults(late=0.05))
    counted = running.stream().assembler
    assert injected.late > 10
    assert counted.late == counted.chunks_lost == injected.late
    assert counted.scans_torn == injected.scans_spoilt


@pytest.mark.long
def test_short_and_remote_frames(running: Hand) -> None:
    injected = running.suffer(Faults(short=0.03, remote=0.03))
    counted, bus = running.stream().assembler, running.host.stats().buses["can0"]
    assert injected.short > 5
    assert injected.remote > 5
    assert counted.bad_length == bus.malformed == injected.short
    assert bus.ignored == injected.remote
    assert counted.chunks_lost == injected.short + injected.remote
    assert counted.scans_torn == injected.scans_spoilt


@pytest.mark.long
def test_heartbeats_that_are_too_long(running: Hand) -> None:
    running.fleet.inject(Faults(long=1.0), "p0")
    assert eventually(lambda: running.fleet.injected("p0").long == 2)  # three would make it lost
    running.fleet.inject(NO_FAULTS)
    running.scans(5)
    long = running.fleet.injected("p0").long
    assert running.host.stats().buses["can0"].malformed == long
    assert [error.cob_id for error in running.host.stats().malformed] == [0x705]


@pytest.mark.long
def test_counters_of_scans_long_past_or_impossible(running: Hand) -> None:
    injected = running.suffer(Faults(miscounted=0.03, miscounted_by=-10))
    counted = running.stream().assembler
    assert injected.miscounted > 5
    assert counted.late + counted.bad_counter == counted.chunks_lost == injected.miscounted
    assert counted.scans_torn == injected.scans_spoilt


@pytest.mark.long
def test_any_wrong_counter_is_followed_by_the_stream_within_a_second(running: Hand) -> None:
    """One of a scan to come stops the stream for three periods: nobody can know which counter is right. What
    becomes of each of them is counted in tests/sim/test_faults_in_time.py, where time stands still."""
    injected = running.suffer(Faults(miscounted=0.01))
    assert injected.miscounted > 2
    for _ in range(20):  # until this machine was fast enough for the node
        skipped = overruns(running.fleet, "p0")
        running.scans(5)
        before = running.stream().assembler
        running.scans(5)
        after = running.stream().assembler
        if overruns(running.fleet, "p0") == skipped:
            break
    assert after.scans_complete >= before.scans_complete + 4
    whole = dataclasses.replace(
        after,
        scans_complete=before.scans_complete,
        chunks_accepted=before.chunks_accepted,
        summaries_accepted=before.summaries_accepted,
    )
    assert whole == before  # whole scans and nothing else


def test_two_scans_under_one_counter_are_thrown_away(running: Hand) -> None:
    injected = running.suffer(Faults(torn=0.4))
    counted, skipped = running.skipped()
    assert injected.torn > 2
    assert counted.scans_missed == injected.torn + skipped
    assert counted.scans_mixed == injected.torn
    assert counted.conflicts == injected.torn_chunks
    assert counted.scans_torn == counted.chunks_lost == counted.late == 0


@pytest.mark.long
def test_lost_summaries(running: Hand) -> None:
    injected = running.suffer(Faults(summary_lost=0.4))
    counted = running.stream().assembler
    assert injected.summary_lost > 2
    assert counted.summaries_lost == injected.summary_lost
    assert counted.scans_unchecked == injected.summary_lost
    assert counted.scans_torn == counted.chunks_lost == 0


@pytest.mark.long
def test_lost_syncs(running: Hand) -> None:
    injected = running.suffer(Faults(sync_lost=0.4))
    counted, skipped = running.skipped()
    assert injected.sync_lost > 2
    assert counted.scans_missed == injected.sync_lost + skipped
    assert counted.scans_torn == counted.chunks_lost == 0


@pytest.mark.long
def test_everything_at_once(running: Hand) -> None:
    chunks = ("lost", "duplicated", "reordered", "late", "short", "remote", "miscounted")
    faults = dict.fromkeys(chunks, 0.02) | dict.fromkeys(("torn", "summary_lost", "sync_lost"), 0.06)
    injected = running.suffer(Faults(miscounted_by=-10, **faults), 2 * SCANS)
    bus = running.host.stats().buses["can0"]
    counted, skipped = running.skipped()
    assert min(dataclasses.asdict(injected)[fault] for fault in faults) > 0
    assert counted.bad_length == bus.malformed == injected.short
    assert bus.ignored == injected.remote
    assert counted.duplicates == injected.duplicated
    assert counted.late + counted.bad_counter == injected.late + injected.miscounted
    assert counted.chunks_lost == (
        injected.lost + injected.late + injected.short + injected.remote + injected.miscounted
    )
    assert counted.scans_torn == injected.scans_spoilt
    assert counted.scans_mixed == injected.torn
    assert counted.conflicts == injected.torn_chunks
    assert counted.summaries_lost == injected.summary_lost
    assert counted.scans_missed == injected.torn + injected.sync_lost + skipped


# --- what neither counters nor numbers show


def test_codes_changed_after_they_were_packed(running: Hand) -> None:
    injected = running.suffer(Faults(corrupted=0.02))
    counted = running.stream().assembler
    assert injected.corrupted > 5
    assert counted.scans_corrupt == injected.scans_spoilt
    assert counted.scans_torn == counted.chunks_lost == counted.conflicts == counted.scans_unchecked == 0
    assert losses_of_stream(running.stream())["scans_corrupt"].endswith("discarded by the check")


@pytest.mark.long
def test_chunks_with_the_counter_of_the_next_scan_that_loses_its_own(running: Hand) -> None:
    injected = running.suffer(Faults(displaced=0.4))
    counted = running.stream().assembler
    assert injected.displaced > 2
    assert counted.scans_corrupt == injected.displaced
    assert counted.scans_mixed == counted.conflicts == 0


@pytest.mark.long
def test_summaries_that_claim_that_the_rest_is_unchanged(running: Hand) -> None:
    injected = running.suffer(Faults(understated=0.4))
    counted = running.stream().assembler
    assert injected.understated > 2
    # After one that is thrown away nothing is known of chunks that are not sent: the next cannot be checked.
    assert counted.scans_corrupt + counted.scans_unchecked == injected.understated
    assert counted.scans_corrupt > 0
    assert counted.scans_torn == counted.chunks_lost == 0


@pytest.mark.long
def test_summaries_without_the_check_that_the_node_sends(running: Hand) -> None:
    injected = running.suffer(Faults(unchecked=0.4))
    counted, bus = running.stream().assembler, running.host.stats().buses["can0"]
    assert injected.unchecked > 2
    assert counted.bad_form == counted.scans_unchecked == counted.summaries_lost == injected.unchecked
    assert bus.malformed == injected.unchecked
    assert counted.scans_torn == counted.chunks_lost == 0


@pytest.mark.long
def test_nodes_of_both_revisions_on_one_bus(
    make_hand: Callable[..., HandConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """p0 sends no checks, and its scans are complete without them; those of p1 are not."""
    hand = make_hand()
    tags = Tags(monkeypatch)
    with Fleet(hand, wire_up=tags.wire_up, unchecked=("p0",)) as fleet:
        with Host.from_config(hand) as host:
            both = Hand(fleet, host, tags)
            both.scans(3)
            for name in ("p0", "p1"):
                fleet.inject(Faults(summary_lost=0.2), name)
            both.scans(SCANS)
            fleet.inject(NO_FAULTS)
            both.scans(8)
            assert eventually(lambda: host.health("p1").condition is Condition.OPERATIONAL)
        stats = host.stats()
        assert discrepancies(stats) == []
        old, new = (stats.patches[name].assembler for name in ("p0", "p1"))
        lost = {name: fleet.injected(name).summary_lost for name in ("p0", "p1")}
        assert min(lost.values()) > 2
        # a node that the machine holds up ends its scan without a summary, and says so
        late = {node.patch: node.overruns for node in fleet.report()}
        assert 0 <= old.summaries_lost - lost["p0"] <= late["p0"]
        assert 0 <= new.summaries_lost - lost["p1"] <= late["p1"]
        assert (old.scans_unchecked, new.scans_unchecked) == (0, new.summaries_lost)
        assert old.scans_torn == new.scans_torn == old.scans_corrupt == new.scans_corrupt == 0
        assert old.bad_form == new.bad_form == 0
        assert tags.mixed == []
        assert tags.seen > 2 * SCANS


@pytest.mark.long
def test_threads_do_not_pile_up(running: Hand) -> None:
    before = threading.active_count()
    running.suffer(Faults(lost=0.2, sync_lost=0.2))
    assert eventually(lambda: threading.active_count() <= before)
    assert np.isfinite(running.host.stats().buses["can0"].load)
