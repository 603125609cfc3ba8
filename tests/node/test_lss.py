"""LSS slave: the services of CiA 305 as raw frames, one slave or several on a wire of our own."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.canopen.lss import LssAddress, LssState
from skinnode.node.lss import LssSlave

ADDRESS = LssAddress(0x0000_0360, 0x534B_494E, 0x0001_0000, 0x0102_0304)
SELECT = (
    "40 60 03 00 00 00 00 00",
    "41 4e 49 4b 53 00 00 00",
    "42 00 00 01 00 00 00 00",
    "43 04 03 02 01 00 00 00",
)
TO_CONFIGURATION = "04 01 00 00 00 00 00 00"
TO_WAITING = "04 00 00 00 00 00 00 00"
NOBODY = 0xFF


class Outside:
    """What a slave brings about."""

    def __init__(self) -> None:
        self.stored: list[tuple[int, int | None]] = []
        self.activated: list[tuple[int | None, int]] = []
        self.broken = False

    def store(self, node_id: int, bit_rate_bps: int | None) -> None:
        if self.broken:
            raise OSError("no space left on device")
        self.stored.append((node_id, bit_rate_bps))

    def activate(self, bit_rate_bps: int | None, delay_ms: int) -> None:
        self.activated.append((bit_rate_bps, delay_ms))


@pytest.fixture
def outside() -> Outside:
    return Outside()


@pytest.fixture
def slave(outside: Outside) -> LssSlave:
    """Node 4, whose bit rate can be one of two."""
    return LssSlave(
        ADDRESS,
        4,
        bit_rates_bps=(1_000_000, 250_000),
        store=outside.store,
        activate=outside.activate,
    )


def ask(slave: LssSlave, frame: str) -> str | None:
    answer = slave.on_request(bytes.fromhex(frame))
    return None if answer is None else answer.hex(" ")


def configuring(slave: LssSlave) -> LssSlave:
    ask(slave, TO_CONFIGURATION)
    return slave


def test_switch_state_global_is_not_answered(slave: LssSlave) -> None:
    assert ask(slave, TO_CONFIGURATION) is None
    assert slave.state is LssState.CONFIGURATION
    assert ask(slave, TO_WAITING) is None
    assert slave.state is LssState.WAITING
    assert ask(slave, "04 02 00 00 00 00 00 00") is None
    assert slave.state is LssState.WAITING


def test_switch_state_selective(slave: LssSlave) -> None:
    assert [ask(slave, frame) for frame in SELECT] == [None, None, None, "44 00 00 00 00 00 00 00"]
    assert slave.state is LssState.CONFIGURATION


@pytest.mark.parametrize("wrong", range(4))
def test_selecting_another_leaves_this_one_alone(slave: LssSlave, wrong: int) -> None:
    frames = [bytearray.fromhex(frame) for frame in SELECT]
    frames[wrong][2] ^= 1
    assert [slave.on_request(bytes(frame)) for frame in frames] == [None] * 4
    assert slave.state is LssState.WAITING
    assert ask(slave, SELECT[3]) is None  # nor does what was wrong before become right by its last part


def test_the_parts_of_an_address_have_an_order(slave: LssSlave) -> None:
    for order in ((1, 0, 2, 3), (0, 1, 3, 2), (1, 2, 3, 3), (0, 2, 3, 3), (0, 0, 2, 3)):
        assert [ask(slave, SELECT[i]) for i in order] == [None] * 4
    assert [ask(slave, SELECT[i]) for i in (0, 1, 0, 1, 2, 3)][-1] == "44 00 00 00 00 00 00 00"


class TestConfigure:
    @pytest.mark.parametrize(("node_id", "error"), [(1, 0), (127, 0), (255, 0), (0, 1), (128, 1), (254, 1)])
    def test_node_id(self, slave: LssSlave, node_id: int, error: int) -> None:
        configuring(slave)
        assert ask(slave, f"11 {node_id:02x} 00 00 00 00 00 00") == f"11 {error:02x} 00 00 00 00 00 00"
        assert slave.pending_node_id == (4 if error else node_id)
        assert slave.node_id == 4  # until communication is reset
        slave.reset_communication()
        assert slave.node_id == (4 if error else node_id)
        assert slave.state is LssState.WAITING

    @pytest.mark.parametrize(
        ("timing", "error"),
        [("00 00", 0), ("00 03", 0), ("00 02", 1), ("00 05", 1), ("00 09", 1), ("01 00", 1), ("00 ff", 1)],
    )
    def test_bit_timing(self, slave: LssSlave, timing: str, error: int) -> None:
        """1 Mbit/s and 250 kbit/s are supported; 500 kbit/s is not, index 5 is reserved, 9 automatic."""
        configuring(slave)
        assert ask(slave, f"13 {timing} 00 00 00 00 00") == f"13 {error:02x} 00 00 00 00 00 00"

    def test_bit_timing_is_activated_after_a_delay(self, slave: LssSlave, outside: Outside) -> None:
        configuring(slave)
        ask(slave, "13 00 03 00 00 00 00 00")
        assert outside.activated == []
        assert ask(slave, "15 2c 01 00 00 00 00 00") is None
        assert outside.activated == [(250_000, 300)]

    def test_bit_rate_that_is_not_the_slaves_own(self) -> None:
        slave = configuring(LssSlave(ADDRESS, 4))
        assert ask(slave, "13 00 00 00 00 00 00 00") == "13 01 00 00 00 00 00 00"
        assert ask(slave, "15 0a 00 00 00 00 00 00") is None

    def test_store(self, slave: LssSlave, outside: Outside) -> None:
        configuring(slave)
        assert ask(slave, "17 00 00 00 00 00 00 00") == "17 00 00 00 00 00 00 00"
        ask(slave, "11 ff 00 00 00 00 00 00")
        ask(slave, "13 00 00 00 00 00 00 00")
        ask(slave, "17 00 00 00 00 00 00 00")
        assert outside.stored == [(4, None), (0xFF, 1_000_000)]

    def test_store_that_fails(self, slave: LssSlave, outside: Outside) -> None:
        outside.broken = True
        assert ask(configuring(slave), "17 00 00 00 00 00 00 00") == "17 02 00 00 00 00 00 00"

    def test_store_without_a_memory(self) -> None:
        slave = configuring(LssSlave(ADDRESS, 4))
        assert ask(slave, "17 00 00 00 00 00 00 00") == "17 01 00 00 00 00 00 00"


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("5a", "5a 60 03 00 00 00 00 00"),
        ("5b", "5b 4e 49 4b 53 00 00 00"),
        ("5c", "5c 00 00 01 00 00 00 00"),
        ("5d", "5d 04 03 02 01 00 00 00"),
        ("5e", "5e 04 00 00 00 00 00 00"),
    ],
)
def test_inquire(slave: LssSlave, request_: str, answer: str) -> None:
    frame = request_ + " 00 00 00 00 00 00 00"
    assert ask(slave, frame) is None  # only in the configuration state
    assert ask(configuring(slave), frame) == answer


def test_inquired_node_id_is_the_active_one(slave: LssSlave) -> None:
    ask(configuring(slave), "11 07 00 00 00 00 00 00")
    assert ask(slave, "5e 00 00 00 00 00 00 00") == "5e 04 00 00 00 00 00 00"


IDENTIFY = (
    "46 60 03 00 00 00 00 00",
    "47 4e 49 4b 53 00 00 00",
    "48 00 00 01 00 00 00 00",
    "49 ff ff 01 00 00 00 00",
    "4a 00 03 02 01 00 00 00",
    "4b 04 03 02 01 00 00 00",
)


@pytest.mark.parametrize("state", [TO_WAITING, TO_CONFIGURATION])
def test_identify_remote_slave(slave: LssSlave, state: str) -> None:
    ask(slave, state)
    assert [ask(slave, frame) for frame in IDENTIFY] == [None] * 5 + ["4f 00 00 00 00 00 00 00"]
    assert slave.state == bytes.fromhex(state)[1]


@pytest.mark.parametrize(
    ("at", "outside_range"),
    [
        (0, "46 61 03 00 00 00 00 00"),
        (1, "47 4f 49 4b 53 00 00 00"),
        (2, "48 01 00 01 00 00 00 00"),
        (3, "49 ff ff 00 00 00 00 00"),
        (4, "4a 05 03 02 01 00 00 00"),
        (5, "4b 03 03 02 01 00 00 00"),
    ],
)
def test_identify_other_slaves(slave: LssSlave, at: int, outside_range: str) -> None:
    frames = [*IDENTIFY]
    frames[at] = outside_range
    assert [ask(slave, frame) for frame in frames] == [None] * 6


def test_identify_non_configured(slave: LssSlave) -> None:
    assert ask(slave, "4c 00 00 00 00 00 00 00") is None
    blank = LssSlave(ADDRESS, NOBODY)
    assert ask(blank, "4c 00 00 00 00 00 00 00") == "50 00 00 00 00 00 00 00"
    ask(configuring(blank), "11 09 00 00 00 00 00 00")
    assert ask(blank, "4c 00 00 00 00 00 00 00") is None  # it has one in hand


def test_a_slave_without_node_id_may_boot_when_let_go() -> None:
    blank = LssSlave(ADDRESS, NOBODY)
    ask(blank, TO_WAITING)
    assert not blank.may_boot
    ask(configuring(blank), "11 09 00 00 00 00 00 00")
    assert not blank.may_boot
    ask(blank, TO_WAITING)
    assert blank.may_boot
    blank.reset_communication()
    assert not blank.may_boot
    assert blank.node_id == 9


def test_a_slave_with_a_node_id_waits_for_the_reset(slave: LssSlave) -> None:
    ask(configuring(slave), "11 09 00 00 00 00 00 00")
    ask(slave, TO_WAITING)
    assert not slave.may_boot
    assert slave.node_id == 4


def scan(slaves: list[LssSlave]) -> tuple[int, ...] | None:
    """The master's side of fastscan (CiA 305 v3.0, figure 46): silence of all is a bit that is set."""

    def anybody(value: int, bit: int, part: int, next_part: int) -> bool:
        frame = b"\x51" + value.to_bytes(4, "little") + bytes((bit, part, next_part))
        answers = {slave.on_request(frame) for slave in slaves} - {None}
        assert answers <= {bytes.fromhex("4f 00 00 00 00 00 00 00")}
        return bool(answers)

    if not anybody(0, 0x80, 0, 0):
        return None
    found = []
    for part in range(4):
        value = 0
        for bit in reversed(range(32)):
            if not anybody(value, bit, part, part):
                value |= 1 << bit
        if not anybody(value, 0, part, (part + 1) % 4):
            return None
        found.append(value)
    return tuple(found)


class TestFastscan:
    def test_only_slaves_without_a_node_id_take_part(self, slave: LssSlave) -> None:
        assert scan([slave]) is None

    def test_confirm(self) -> None:
        assert ask(LssSlave(ADDRESS, NOBODY), "51 00 00 00 00 80 00 00") == "4f 00 00 00 00 00 00 00"

    @pytest.mark.parametrize(
        "frame", ["51 60 03 00 00 20 00 00", "51 60 03 00 00 00 04 00", "51 60 03 00 00 00 00 04"]
    )
    def test_questions_that_do_not_exist(self, frame: str) -> None:
        assert ask(LssSlave(ADDRESS, NOBODY), frame) is None

    @pytest.mark.parametrize(
        ("value", "bit", "agrees"),
        [
            ("60 03 00 00", 0, True),
            ("61 03 00 00", 0, False),
            ("7f 03 00 00", 5, True),  # 0x360 but for bits 0 to 4
            ("5f 03 00 00", 5, False),  # less than 2⁵ away, but not the same above
            ("ff ff ff 7f", 31, True),
            ("60 03 00 80", 31, False),
        ],
    )
    def test_bits_below_the_one_to_check_do_not_matter(self, value: str, bit: int, agrees: bool) -> None:
        slave = LssSlave(ADDRESS, NOBODY)
        ask(slave, "51 00 00 00 00 80 00 00")
        assert ask(slave, f"51 {value} {bit:02x} 00 00") == ("4f 00 00 00 00 00 00 00" if agrees else None)

    @settings(max_examples=30, deadline=None)
    @given(st.sets(st.tuples(*[st.integers(0, 2**32 - 1)] * 4), min_size=1, max_size=5))
    def test_finds_every_slave_once(self, addresses: set[tuple[int, ...]]) -> None:
        slaves = [LssSlave(LssAddress(*address), NOBODY) for address in addresses]
        for node_id in range(1, len(slaves) + 1):
            found = scan(slaves)
            chosen = [slave for slave in slaves if slave.state is LssState.CONFIGURATION]
            assert [slave._address for slave in chosen] == [found]
            assert ask(chosen[0], f"11 {node_id:02x} 00 00 00 00 00 00") == "11 00 00 00 00 00 00 00"
            for slave in slaves:
                ask(slave, TO_WAITING)
        assert scan(slaves) is None
        assert sorted(slave.pending_node_id for slave in slaves) == [*range(1, len(slaves) + 1)]

    def test_serial_numbers_alone_decide(self) -> None:
        """As in a box of new patches."""
        slaves = [LssSlave(ADDRESS._replace(serial_number=serial), NOBODY) for serial in (7, 5, 6)]
        assert scan(slaves) == ADDRESS._replace(serial_number=5)  # clear bits are tried first
        assert [slave.state for slave in slaves] == [0, 1, 0]


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=8), st.binary(min_size=8, max_size=8)), max_size=20))
def test_whatever_comes(frames: list[bytes]) -> None:
    slave = LssSlave(ADDRESS, NOBODY, bit_rates_bps=(1_000_000,))
    for frame in [bytes.fromhex(TO_CONFIGURATION), *frames]:
        answer = slave.on_request(frame)
        assert answer is None or len(answer) == 8 == len(frame)
    assert slave.pending_node_id in {*range(1, 128), 0xFF}
