"""Scans that change no chunk: found from the resistances as from the codes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.model.layout import Float
from skinnode.node.patch.acquisition import Acquisition
from skinnode.node.patch.chunk_selection import ChunkSelection
from skinnode.node.patch.quiet_band import QuietBand
from skinnode.node.patch.wire_faults import find_faults
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.profile import PatchProfile

PROFILE = {bits: PatchProfile(3, 5, 2, 2, code_bits=bits) for bits in (16, 24)}


class Source:
    """Readings that a test sets."""

    def __init__(self, ohm: Float) -> None:
        self.ohm = ohm

    def read(self, t_ns: int) -> Float:
        return self.ohm


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 10**6), st.sampled_from([16, 24]), st.sampled_from([0, 1, 2, 30]), st.sampled_from([0, 4])
)
def test_as_if_each_scan_were_encoded(seed: int, bits: int, threshold: int, refresh: int) -> None:
    random, profile, scale = np.random.default_rng(seed), PROFILE[bits], CodeScale(bits)
    baseline = random.uniform(50.0, 5000.0, (3, 5))
    baseline[0, 0] *= random.choice([1.0, 0.0], p=[0.9, 0.1])
    source = Source(baseline)
    acquisition, selection = Acquisition(profile, source, scale, baseline), ChunkSelection(profile, scale)
    known, codes = acquisition.baseline_ohm.astype(np.float64), None
    spread = random.choice([0.4, 1.0, 3.0]) * max(threshold, 0.4) * scale.step
    for _ in range(40):
        ratio = 1.0 + spread * random.standard_normal((3, 5))
        ohm = np.where(known > 0.0, known, 1.0) * ratio
        if random.random() < 0.05:
            ohm[tuple(random.integers((3, 5)))] = random.choice([np.nan, np.inf, 0.0, -1.0, 1e9])
        if random.random() < 0.05:
            ohm[1] = np.inf
        if random.random() < 0.05:
            acquisition.set_baseline(2, 1, float(known[2, 1] * 1.001))
            known = acquisition.baseline_ohm.astype(np.float64)
            assert codes is None or np.array_equal(acquisition.codes, codes)  # of the scan before
            selection.forget()
        source.ohm = ohm
        acquisition.sample(0)
        codes = encode(ohm, acquisition.baseline_ohm, scale)
        faults = find_faults(codes, scale)
        assert [mask.tolist() for mask in acquisition.faults.masks] == [
            mask.tolist() for mask in faults.masks
        ]
        chunks = selection.changed_chunks(codes, threshold, refresh)
        assert acquisition.changed_chunks(threshold, refresh) == chunks
        assert np.array_equal(acquisition.selection.sent, selection.sent)
        assert np.array_equal(acquisition.codes, codes)


def test_a_quiet_scan_is_not_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    scale, ohm = CodeScale(16), np.full((3, 5), 200.0)
    acquisition = Acquisition(PROFILE[16], Source(ohm), scale, ohm)
    for _ in range(2):  # a full scan, then one that changes nothing
        acquisition.sample(0)
        acquisition.changed_chunks(2, 10)
    monkeypatch.setattr("skinnode.node.patch.acquisition.encode", lambda *_: pytest.fail("encoded"))
    for _ in range(7):
        acquisition.sample(0)
        assert acquisition.changed_chunks(2, 10) == []


@pytest.mark.parametrize("bits", [16, 24])
def test_the_limits_of_the_band_keep_their_codes(bits: int) -> None:
    """At the limits, no code differs by more than the threshold; a little beyond, one does."""
    scale, baseline = CodeScale(bits), np.linspace(90.0, 7000.0, 15).reshape(3, 5)
    sent = np.linspace(40, scale.steps - 40, 15).astype(np.uint32).reshape(3, 5)
    band = QuietBand.of(sent, 3, baseline, scale)
    assert band is not None
    for limit_ohm, outward in ((band.low_ohm, -1), (band.high_ohm, 1)):
        apart = encode(limit_ohm, baseline, scale).astype(np.int64) - sent
        assert (apart == 3 * outward).all()
        beyond = limit_ohm + outward * 0.002 * scale.step * baseline.astype(np.float32)
        assert (encode(beyond, baseline, scale).astype(np.int64) - sent == 4 * outward).all()


@pytest.mark.parametrize(
    ("code", "ohm"), [(None, 0.0), (None, np.inf), ("open", 100.0), ("over_range", 100.0)]
)
def test_no_band_without_a_baseline_or_a_measurement(code: str | None, ohm: float) -> None:
    scale, baseline = CodeScale(16), np.full((2, 2), 100.0)
    sent = np.full((2, 2), 1000, np.uint32)
    baseline[0, 1] = ohm
    if code is not None:
        sent[1, 1] = getattr(scale, code)
    assert QuietBand.of(sent, 2, baseline, scale) is None
