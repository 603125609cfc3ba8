"""Fields and health that cross a network: nothing is lost, and foreign code reads them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic

from skinnode.host.converter_liveness import Alive
from skinnode.host.events import HealthEvent
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.open_and_shorted_wires import WireFault, WireState
from skinnode.messages.definitions import FIELD, HEALTH_REPORT
from skinnode.messages.full_field import SendStamp, decode_field, encode_field
from skinnode.messages.health import LOG, event_of, log_message
from skinnode.messages.health_report import HealthReport, decode_report, encode_report
from skinnode.messages.typestore import decode, encode, schema_text
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.frames import Contact, FieldFrame, ScanStamp, SolveStats
from skinnode.model.status import Status

SENT = SendStamp(
    1_790_000_000_000_000_001, 2**40 + 3, 1_790_000_000_123_456_789, 1_700_000_000_000_000_000, 2**32 - 5
)
STAMP = ScanStamp("palm", 300, 44, 4_294_967_295, 5_000_000_001, 5_010_000_002, 5_011_000_003)


def a_contact(rng: np.random.Generator) -> Contact:
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    vectors = rng.normal(size=(2, 3)), rng.normal(size=(2, 2))
    values = rng.normal(size=4).tolist()
    return Contact(
        vectors[0][0], abs(vectors[0][1]), values[0], values[1], values[2], values[3], *vectors[1], True, axes
    )


def full(seed: int) -> FieldFrame:
    """A field in which every value that may be missing is present."""
    rng = np.random.default_rng(seed)
    arrays = rng.normal(size=(5, 4, 3, 3))
    masks = rng.random((3, 4)) < 0.5
    return FieldFrame(
        displacement_m=arrays[0],
        displacement_std_m=np.where(arrays[1] > 1, math.inf, abs(arrays[1])),
        status=tuple(Status(i) for i in rng.integers(0, 9, 4)),
        residual=rng.random(4),
        stats=SolveStats(1, 2, 3, 0.25),
        force_n=arrays[2],
        stamp=STAMP,
        method="posterior",
        by_prior=masks[0],
        contacts=tuple(a_contact(rng) for _ in range(3)),
        gain=rng.normal(size=4),
        noise_factor=1.5,
        held=masks[1],
        core_std_m=arrays[3],
        distrust="wire 3: does not converge",
        wires_trusted=masks[2],
        precise=False,
        data_share=arrays[4],
        touched=True,
        touch_odds=math.inf,
        faults=(
            DataFault(FaultyPart.CROSSING, FaultKind.NOISY, 0, 2, 17, math.inf),
            DataFault(FaultyPart.PATCH, FaultKind.FROZEN, since=3),
        ),
    )


def bare() -> FieldFrame:
    """A field in which every value that may be missing is missing."""
    zero = np.zeros((2, 3, 3))
    return FieldFrame(
        zero, zero + 1, (Status.CONVERGED,) * 2, np.zeros(2), SolveStats(0, 0, 0, 0.0), stamp=STAMP
    )


def assert_same(got: object, wanted: object) -> None:
    if dataclasses.is_dataclass(wanted) and not isinstance(wanted, type):
        assert type(got) is type(wanted)
        for entry in dataclasses.fields(wanted):
            assert_same(getattr(got, entry.name), getattr(wanted, entry.name))
    elif isinstance(wanted, tuple):
        assert isinstance(got, tuple)
        assert len(got) == len(wanted)
        for ours, theirs in zip(got, wanted, strict=True):
            assert_same(ours, theirs)
    elif isinstance(wanted, np.ndarray):
        assert isinstance(got, np.ndarray)
        assert (got.dtype, got.shape) == (wanted.dtype, wanted.shape)
        assert got.tobytes() == wanted.tobytes()
        assert not got.flags.writeable
    else:
        assert (got, type(got)) == (wanted, type(wanted))


def test_the_full_field_tries_every_value() -> None:
    """A value that is added to a field and left out here would be lost unnoticed."""
    for entry in dataclasses.fields(FieldFrame):
        value = getattr(full(1), entry.name)
        assert isinstance(value, np.ndarray) or value != entry.default, entry.name


@pytest.mark.parametrize("field", [full(1), full(2), bare()], ids=["full", "other", "bare"])
def test_a_field_arrives_bit_for_bit(field: FieldFrame) -> None:
    got, sent = decode_field(encode_field(field, SENT))
    assert sent == SENT
    assert_same(got, field)


def test_foreign_code_reads_a_field() -> None:
    field = full(3)
    message = generate_dynamic(FIELD, schema_text(FIELD))[FIELD](encode_field(field, SENT))
    assert (message.sequence, message.started_ns, message.sent_ns) == (
        SENT.sequence,
        SENT.started_ns,
        SENT.sent_ns,
    )
    assert (message.upper_wires, message.electrodes, message.info.patch) == (4, 3, "palm")
    assert list(message.displacement) == field.displacement_m.reshape(-1).tolist()
    assert list(message.force) == np.asarray(field.force_n).reshape(-1).tolist()
    assert [each.normal_force for each in message.contacts] == [c.normal_force_n for c in field.contacts]
    normals = [each.normal for each in message.contacts]
    assert list(message.contact_axes)[6:9] == pytest.approx([normals[0].x, normals[0].y, normals[0].z])


@pytest.mark.parametrize("cut", [0, 1, 4, 60, 300, -1])
def test_a_cut_field_is_refused(cut: int) -> None:
    data = encode_field(full(4), SENT)
    with pytest.raises(ValueError, match="skinnode_msgs/msg/Field"):
        decode_field(data[:cut])


def test_a_report_of_the_health_arrives_unchanged() -> None:
    faults = (DataFault(FaultyPart.LOWER, FaultKind.OPEN, lower=7, since=4, deviations=math.inf),)
    patches = {
        "palm": PatchHealth(
            "palm",
            5,
            Condition.FAULTY,
            127,
            0.25,
            None,
            2,
            1,
            0x8110,
            "overrun",
            0x11,
            wires=(WireFault("upper", 3, WireState.OPEN), WireFault("lower", 0, WireState.NOISY)),
            alive=Alive.NO,
            faults=faults,
            defect='ValueError: "x"\n',
            withheld=True,
        ),
        "heel": PatchHealth("heel", 6, Condition.NEVER_SEEN, None, None, None, 0, 0, None, "", 0),
    }
    from skinnode.transport.bus_state import BusState

    bus = BusHealth(
        "can0", "unplugged", 0.5, 1, 2, 3, 4, 5, 6, 2, (0x181, 0x7FF), 8, 9, BusState.PASSIVE, True
    )
    other = dataclasses.replace(bus, bus="can1", away=None, controller=None, foreign_ids=())
    report = HealthReport(
        SENT.started_ns, patches, {"can0": bus, "can1": other}, {"palm": 2**40, "heel": 0}, 7
    )
    data = encode_report(report, SENT.sent_ns)
    assert decode_report(data) == report
    foreign = generate_dynamic(HEALTH_REPORT, schema_text(HEALTH_REPORT))[HEALTH_REPORT](data)
    assert foreign.started_ns == SENT.started_ns
    assert decode_report(data).patches["palm"].reason == patches["palm"].reason


@pytest.mark.parametrize("json", ["", "[]", "{}", '{"patches": {"p": {}}, "buses": {}}', '{"patches": 5}'])
def test_a_report_of_another_kind_is_refused(json: str) -> None:
    from skinnode.messages.typestore import header, message_type

    data = encode(message_type(HEALTH_REPORT)(header(0, ""), 1, json), HEALTH_REPORT)
    with pytest.raises(ValueError, match=r"HealthReport|Expecting"):
        decode_report(data)


def test_an_event_arrives_unchanged() -> None:
    event = HealthEvent(0, "Däumling", "touched", "touched since scan 7")
    message = decode(encode(log_message(event, SENT.sent_ns), LOG), LOG)
    assert event_of(message) == (event, SENT.sent_ns)
