"""What may be written to PDO parameters, and that whatever is written leaves them consistent (CiA 301 v4.2,
7.5.2.33 to 7.5.2.38; abort codes where the standard leaves them open: CANopenNode's)."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable

import pytest
from canopen.objectdictionary import ObjectDictionary, ODVariable, eds
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.model.layout import PatchLayout
from skinnode.node import VolatileMemory
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.pdo.parameters import PdoRecords
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile

REGISTER, COUNTER, TIME, CODE = 0x1001_0008, 0x2011_0108, 0x2011_0420, 0x2100_0110
MODE, TARE = 0x2020_0108, 0x2021_0420

ABORTS = {
    "access": "00 00 01 06",
    "no object": "00 00 02 06",
    "not mappable": "41 00 04 06",
    "too long": "42 00 04 06",
    "incompatible": "43 00 04 06",
    "no sub-index": "11 00 09 06",
    "value": "30 00 09 06",
}


def download(desk, index: int, subindex: int, value: int, size: int) -> str:
    """Expedited; the abort code, empty if there was none."""
    head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
    answer = desk.sdo((head + value.to_bytes(size, "little").ljust(4, b"\0")).hex())
    return "" if answer.startswith("60") else answer[12:]


@pytest.mark.parametrize(("parameter", "cob_id"), [(0x1802, 0x384), (0x1402, 0x404)])
class TestBothWays:
    """TPDO3 and RPDO3 are spare: off, nothing mapped, the COB-ID of the pre-defined connection set."""

    def test_as_they_are_from_the_start(self, desk, parameter: int, cob_id: int) -> None:
        assert desk.read(parameter, 1) == 0x8000_0000 | cob_id
        assert desk.read(parameter, 2) == 254
        assert desk.read(parameter + 0x200, 0) == 0

    def test_on_only_with_something_mapped(self, desk, parameter: int, cob_id: int) -> None:
        assert download(desk, parameter, 1, cob_id, 4) == ABORTS["value"]

    def test_an_entry_is_not_mapped_before_the_count_says_so(self, desk, parameter: int, cob_id: int) -> None:
        desk.write(parameter + 0x200, 1, REGISTER if parameter >= 0x1800 else MODE, 4)
        assert download(desk, parameter, 1, cob_id, 4) == ABORTS["value"]
        desk.write(parameter + 0x200, 0, 1, 1)
        assert download(desk, parameter, 1, cob_id, 4) == ""

    def test_mapping_while_on(self, desk, parameter: int, cob_id: int) -> None:
        entry = REGISTER if parameter >= 0x1800 else MODE
        desk.configure_pdo(parameter, entry, cob_id=cob_id)
        assert download(desk, parameter + 0x200, 0, 0, 1) == ABORTS["access"]
        assert download(desk, parameter + 0x200, 1, entry, 4) == ABORTS["access"]
        assert desk.read(parameter + 0x200, 0) == 1

    def test_cob_id_while_on(self, desk, parameter: int, cob_id: int) -> None:
        desk.configure_pdo(parameter, REGISTER if parameter >= 0x1800 else MODE, cob_id=cob_id)
        assert download(desk, parameter, 1, cob_id + 1, 4) == ABORTS["value"]
        assert download(desk, parameter, 1, cob_id, 4) == ""
        assert download(desk, parameter, 1, 0x8000_0000 | cob_id + 1, 4) == ""  # off and another one at once

    @pytest.mark.parametrize(
        "cob_id_", [0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x7FF]
    )
    def test_restricted_identifiers(self, desk, parameter: int, cob_id: int, cob_id_: int) -> None:
        download(desk, parameter + 0x200, 1, REGISTER if parameter >= 0x1800 else MODE, 4)
        desk.write(parameter + 0x200, 0, 1, 1)
        assert download(desk, parameter, 1, cob_id_, 4) == ABORTS["value"]
        assert desk.read(parameter, 1) == 0x8000_0000 | cob_id

    @pytest.mark.parametrize("bits", [0x2000_0000, 0x0000_0800, 0x1000_0000, 0xA000_0000])
    def test_extended_identifiers_are_not_offered(self, desk, parameter: int, cob_id: int, bits: int) -> None:
        assert download(desk, parameter, 1, bits | cob_id, 4) == ABORTS["value"]

    @pytest.mark.parametrize("count", [9, 64, 65, 254, 255])
    def test_too_many_objects(self, desk, parameter: int, cob_id: int, count: int) -> None:
        assert download(desk, parameter + 0x200, 0, count, 1) == ABORTS["too long"]

    def test_more_objects_than_are_named(self, desk, parameter: int, cob_id: int) -> None:
        desk.write(parameter + 0x200, 1, REGISTER if parameter >= 0x1800 else MODE, 4)
        assert download(desk, parameter + 0x200, 0, 2, 1) == ABORTS["no object"]
        assert desk.read(parameter + 0x200, 0) == 0

    def test_no_ninth_entry(self, desk, parameter: int, cob_id: int) -> None:
        assert download(desk, parameter + 0x200, 9, REGISTER, 4) == ABORTS["no sub-index"]

    @pytest.mark.parametrize(
        ("entry", "abort"),
        [
            (0x1FFF_0008, "no object"),
            (0x2011_0908, "no sub-index"),
            (0x1000_0020, "not mappable"),
            (0x1017_0010, "not mappable"),
            (0x2011_0110, "not mappable"),  # 16 bits of a u8
            (0x2011_0408, "not mappable"),  # 8 bits of a u32
            (0x2300_0020, "not mappable"),  # a domain
        ],
    )
    def test_entries_that_cannot_be(self, desk, parameter: int, cob_id: int, entry: int, abort: str) -> None:
        assert download(desk, parameter + 0x200, 1, entry, 4) == ABORTS[abort]
        assert desk.read(parameter + 0x200, 1) == 0


@pytest.mark.parametrize(
    ("mapping", "entry"),
    [(0x1A02, MODE), (0x1A02, TARE), (0x1602, REGISTER), (0x1602, COUNTER), (0x1602, CODE)],
)
def test_the_wrong_direction(desk, mapping: int, entry: int) -> None:
    assert download(desk, mapping, 1, entry, 4) == ABORTS["not mappable"]


@pytest.mark.parametrize(("mapping", "entry"), [(0x1A02, TIME), (0x1602, TARE)])
def test_longer_than_a_frame(desk, mapping: int, entry: int) -> None:
    for slot in (1, 2, 3):
        desk.write(mapping, slot, entry, 4)
    assert download(desk, mapping, 0, 3, 1) == ABORTS["too long"]
    assert download(desk, mapping, 0, 2, 1) == ""


@pytest.mark.parametrize(("parameter", "kinds"), [(0x1802, range(241, 252)), (0x1402, range(241, 254))])
def test_reserved_types(desk, parameter: int, kinds: range) -> None:
    refused = [kind for kind in range(256) if download(desk, parameter, 2, kind, 1) == ABORTS["value"]]
    assert refused == list(kinds)


@pytest.mark.parametrize(("subindex", "size"), [(3, 2), (6, 1)])
def test_inhibit_time_and_start_value_only_while_off(desk, subindex: int, size: int) -> None:
    desk.configure_pdo(0x1802, REGISTER, cob_id=0x384)
    assert download(desk, 0x1802, subindex, 1, size) == ABORTS["value"]
    assert download(desk, 0x1802, 4, 1, 1) == ABORTS["no sub-index"]  # reserved
    desk.write(0x1802, 1, 0x8000_0384, 4)
    desk.write(0x1802, subindex, 1, size)


def test_what_an_rpdo_does_not_have_reads_as_zero() -> None:
    """0x1400 has neither an inhibit time nor a SYNC start value (CiA 301 v4.2, 7.5.2.35)."""
    store = ObjectStore(PatchProfile(2, 6, 2, 1).objects(), 4)
    rpdo = PdoRecords(store, 0x1400, 0x1600, transmits=False).read()
    assert not store.has(0x1400, 3)
    assert not store.has(0x1400, 6)
    assert (rpdo.inhibit_ns, rpdo.sync_start) == (0, 0)
    assert (rpdo.enabled, rpdo.cob_id, rpdo.kind, rpdo.size) == (True, 0x204, 255, 6)


class TestCanFd:
    """Up to 64 bytes and 64 objects."""

    @pytest.fixture
    def fd(self, make: Callable, layout: PatchLayout):
        return make(profile=PatchProfile.from_layout(layout, 16, "fd"))

    def test_longest_tpdo(self, fd) -> None:
        for slot in range(1, 18):
            fd.write(0x1A02, slot, TIME, 4)
        assert download(fd, 0x1A02, 0, 17, 1) == ABORTS["too long"]
        assert download(fd, 0x1A02, 0, 65, 1) == ABORTS["too long"]
        fd.write(0x1A02, 0, 16, 1)
        fd.write(0x1802, 2, 253, 1)
        fd.write(0x1802, 1, 0x384, 4)
        fd.start()
        (frame,) = fd.frame(0x384, remote=True)
        assert frame == (0x384, " ".join(["00"] * 64))

    def test_padding_of_an_rpdo_is_not_too_long(self, fd) -> None:
        """Nine bytes travel in a frame of twelve."""
        fd.configure_pdo(0x1402, TARE, TARE, MODE, cob_id=0x404, kind=255)
        fd.start()
        assert fd.frame(0x404, "00 " * 8 + "01 00 00 00") == []
        assert fd.read(0x2020, 1) == 1
        assert [data[:5] for _, data in fd.frame(0x404, "00 " * 16)] == ["20 82", "00 00"]
        assert [data[:5] for _, data in fd.frame(0x404, "00 " * 8)] == ["10 82"]


def test_two_tpdos_may_not_share_an_identifier(desk) -> None:
    desk.configure_pdo(0x1802, REGISTER, cob_id=0x3A0)
    for slot, value in ((1, COUNTER), (0, 1)):
        desk.write(0x1A03, slot, value, 4 if slot else 1)
    assert download(desk, 0x1803, 1, 0x3A0, 4) == ABORTS["incompatible"]
    assert download(desk, 0x1803, 1, 0x184, 4) == ABORTS["incompatible"]  # the chunks'
    desk.write(0x1802, 1, 0x8000_03A0, 4)
    desk.write(0x1803, 1, 0x3A0, 4)


DUMMIES = {2: 8, 3: 16, 4: 32, 5: 8, 6: 16, 7: 32}
RESTRICTED = {
    *range(0x080), *range(0x101, 0x181), *range(0x581, 0x600), *range(0x601, 0x680), *range(0x6E0, 0x700),
    *range(0x701, 0x800),
}  # fmt: skip

cob_ids = st.builds(
    lambda number, bits: number | bits,
    st.sampled_from([0x184, 0x284, 0x384, 0x385, 0x304, 0x404, 0x080, 0x604, 0x704, 0x7FF]),
    st.sampled_from([0, 0, 0, 0x8000_0000, 0x8000_0000, 0x4000_0000, 0x2000_0000]),
)
entries = st.sampled_from(
    [
        0,
        REGISTER,
        COUNTER,
        TIME,
        CODE,
        MODE,
        TARE,
        0x0005_0008,
        0x0006_0010,
        0x0001_0001,
        0x1017_0010,
        0x2010_0108,
    ]
)
parameters = st.sampled_from([0x1800, 0x1801, 0x1802, 0x1803, 0x1400, 0x1401, 0x1402])
writes = st.one_of(
    st.tuples(parameters, st.just(1), cob_ids, st.just(4)),
    st.tuples(parameters, st.just(2), st.sampled_from([0, 1, 3, 252, 253, 254, 255, 245]), st.just(1)),
    st.tuples(parameters, st.just(3), st.sampled_from([0, 5]), st.just(2)),
    st.tuples(parameters, st.just(5), st.sampled_from([0, 1, 7]), st.just(2)),
    st.tuples(parameters, st.just(6), st.sampled_from([0, 2]), st.just(1)),
    st.tuples(parameters.map(lambda index: index + 0x200), st.integers(1, 8), entries, st.just(4)),
    st.tuples(parameters.map(lambda index: index + 0x200), st.just(0), st.integers(0, 9), st.just(1)),
)


# ``make`` keeps nothing from one example to the next.
def no_sequence_of_writes_leaves_a_pdo_that_is_on_and_inconsistent(make: Callable, sequence: list) -> None:
    desk = make()
    dictionary = parsed(eds_text(desk.node.profile))
    if sequence[0][2] % 2:
        desk.start()
    for step in sequence:
        download(desk, *step)
    lengths = {}
    for parameter in (0x1800, 0x1801, 0x1802, 0x1803, 0x1400, 0x1401, 0x1402):
        cob_id = desk.read(parameter, 1)
        if cob_id & 0x8000_0000:
            continue
        number, transmits = cob_id & 0x7FF, parameter >= 0x1800
        assert number not in RESTRICTED
        assert not cob_id & 0x3FFF_F800
        assert desk.read(parameter, 2) in {*range(241), 254, 255, *((252, 253) if transmits else ())}
        count = desk.read(parameter + 0x200, 0)
        assert 1 <= count <= 8
        words = [desk.read(parameter + 0x200, slot) for slot in range(1, count + 1)]
        for word in words:
            assert word & 0xFF == _bits(dictionary, word >> 16, word >> 8 & 0xFF, transmits=transmits)
        assert sum(word & 0xFF for word in words) <= 64
        if transmits:
            assert number not in lengths  # no two send under one identifier
            lengths[number] = sum(word & 0xFF for word in words) // 8
    # And they work: what is sent has the length of what is mapped, received frames raise nothing.
    desk.start()
    desk.take()
    for can_id in {*lengths, 0x304, 0x404, 0x204}:
        for data in (b"", b"\x01" * 8):
            desk.node.on_frame(can_id, data, desk.t_ns)
        desk.node.on_frame(can_id, b"", desk.t_ns, True)
    for _ in range(4):
        desk.node.on_frame(0x80, b"", desk.t_ns)
        desk.run(10)
    assert all(len(data) == lengths[can_id] for can_id, data, _ in desk.sent if can_id in lengths)


@pytest.mark.parametrize("examples", [15, pytest.param(80, marks=pytest.mark.long)])
def test_no_sequence_of_writes_leaves_a_pdo_that_is_on_and_inconsistent(
    make: Callable, examples: int
) -> None:
    check = given(sequence=st.lists(writes, min_size=20, max_size=120))(
        no_sequence_of_writes_leaves_a_pdo_that_is_on_and_inconsistent
    )
    settings(deadline=None, max_examples=examples)(check)(make=make)


def test_identifiers_that_were_swapped_and_saved_are_those_after_a_reset(make: Callable) -> None:
    desk = make(memory=VolatileMemory())
    for parameter in (0x1800, 0x1801):
        desk.write(parameter, 1, 0x8000_0400, 4)
    desk.write(0x1800, 1, 0x284, 4)
    desk.write(0x1801, 1, 0x184, 4)
    desk.configure_pdo(0x1803, REGISTER, cob_id=0x3A0)
    desk.write(0x1010, 1, int.from_bytes(b"save", "little"), 4)
    desk.write(0x1803, 1, 0x8000_03A0, 4)
    desk.configure_pdo(0x1802, REGISTER, cob_id=0x3A0)  # not saved
    assert desk.frame(0, "81 04") == [(0x704, "00")]  # and no emergency
    cob_ids = [desk.read(0x1800 + number, 1) for number in range(4)]
    assert cob_ids == [0x284, 0x184, 0x8000_0384, 0x3A0]


@functools.cache
def parsed(text: str) -> ObjectDictionary:
    return eds.import_eds(io.StringIO(text), 4)


def _bits(dictionary: ObjectDictionary, index: int, subindex: int, *, transmits: bool) -> int:
    """Length of an object that a PDO of this direction can hold, as the EDS has it; -1 for any other."""
    if not transmits and subindex == 0 and index in DUMMIES:
        return DUMMIES[index]
    item = dictionary[index]
    variable = item if isinstance(item, ODVariable) else item[subindex]
    allowed = ("ro", "rw", "rwr", "const") if transmits else ("wo", "rw", "rww")
    return len(variable) if variable.pdo_mappable and variable.access_type in allowed else -1
