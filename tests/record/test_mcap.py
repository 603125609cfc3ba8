"""MCAP recordings: read back by foreign parsers, killed, cut and damaged."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import random
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner
from zstandard import ZstdError

from skinnode.cli.main import app
from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.host import Host
from skinnode.messages.definitions import DEFINITIONS, JOURNAL_LINE
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.record import Recorder, Replay, followed, replay
from skinnode.record.convert import convert
from skinnode.record.mcap_file import McapFile
from skinnode.record.mcap_reader import McapReader
from skinnode.transport.frame import Frame
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import START_WALL_NS, VirtualClock

from .test_replay import CHILD, a_hand, key

BASE = "/hand"
FRAME = "can_msgs/msg/Frame"


@pytest.fixture(scope="module")
def run(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, HandConfig, dict[tuple[str, int], FieldFrame]]:
    """A recording of a hand that is pressed, and the fields that its host gave."""
    hand, path = a_hand(), tmp_path_factory.mktemp("mcap") / "run.mcap"
    live: dict[tuple[str, int], FieldFrame] = {}
    with (
        VirtualClock(),
        Fleet(hand),
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder) as host,
        followed(recorder, host),
    ):
        fields, end_s = host.fields(capacity=10_000), clock.monotonic() + 2.5
        while clock.monotonic() < end_s:
            field = fields.get(0.1)
            if field is not None:
                live[key(field)] = field
    stats = recorder.stats()
    assert (stats.failure, stats.dropped, stats.fields_dropped) == (None, 0, 0)
    assert stats.fields >= len(live) > 60
    assert stats.fields == len(list(replay(path)))  # with the scans that ended while the host closed
    return path, hand, live


def test_the_recording_of_the_health_ends_with_the_host(tmp_path: Path) -> None:
    hand, path = a_hand(), tmp_path / "run.mcap"
    with VirtualClock(), Fleet(hand), Recorder(hand, path) as recorder, contextlib.ExitStack() as block:
        with Host.from_config(hand, tap=recorder) as host:
            block.enter_context(followed(recorder, host))
        end_s = clock.monotonic() + 30.0
        while any(each.name == "record health" for each in threading.enumerate()):
            assert clock.monotonic() < end_s  # until then, the thread would poll without a pause
            clock.sleep(0.01)


def chunks_in(data: bytes) -> list[int]:
    """Offsets of the chunks of a file."""
    return [at for at in range(len(data)) if data[at] == 0x06 and data[at + 41 : at + 45] == b"zstd"]


def middle_frames(path: Path) -> int:
    """Offset of the chunk in the middle of those with at least fifty frames; other chunks may have none."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        schemas = {id: each.name for id, each in summary.schemas.items()}
        frames = {id for id, each in summary.channels.items() if schemas[each.schema_id] == FRAME}
        found = []
        for chunk in sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset):
            file.seek(chunk.chunk_start_offset)
            record = next(StreamReader(file, skip_magic=True, emit_chunks=True).records)
            assert isinstance(record, Chunk)
            messages = [each for each in breakup_chunk(record) if isinstance(each, Message)]
            if sum(each.channel_id in frames for each in messages) >= 50:
                found.append(chunk.chunk_start_offset)
    return found[len(found) // 2]


def bits(run: Replay) -> list[tuple[str, int, bytes]]:
    return [(*key(field), field.displacement_m.tobytes()) for field in run]


@pytest.mark.long
def test_rosbags_reads_the_fields_that_the_host_gave(run: Any) -> None:
    path, hand, live = run
    rest_m = {patch.name: patch.layout.build().upper_m for patch in hand.patches}
    clouds: dict[tuple[str, float], Any] = {}
    infos: dict[tuple[str, int], Any] = {}
    contacts: dict[tuple[str, int], Any] = {}
    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            message: Any = bag.deserialize(raw, connection.msgtype)
            if connection.msgtype == "sensor_msgs/msg/PointCloud2":
                clouds[message.header.frame_id, _ns(message.header.stamp)] = message
            elif connection.msgtype == "skinnode_msgs/msg/FieldInfo":
                infos[message.patch, message.scan] = message
            elif connection.msgtype == "skinnode_msgs/msg/Contacts":
                contacts[message.patch, message.scan] = message
    assert set(live) <= set(infos)
    pressed = 0
    for which, field in live.items():
        info, stamp = infos[which], field.stamp
        assert stamp is not None
        cloud = clouds[f"skin/{stamp.patch}", _ns(info.header.stamp)]
        table = _table(cloud)
        position_m = rest_m[stamp.patch] + field.displacement_m
        for axis, letter in enumerate("xyz"):
            same = np.testing.assert_array_equal
            same(table[letter], position_m[..., axis].astype("f4"))
            same(table[f"d{letter}"], field.displacement_m[..., axis].astype("f4"))
            same(table[f"std_{letter}"], field.displacement_std_m[..., axis].astype("f4"))
            if field.force_n is not None:
                same(table[f"f{letter}"], field.force_n[..., axis].astype("f4"))
        assert tuple(info.status) == field.status
        assert info.residual.tobytes() == field.residual.tobytes()
        assert (info.trusted, info.distrust, info.method) == (
            field.trusted,
            field.distrust or "",
            field.method,
        )
        assert (info.t_receive_ns, info.t_solved_ns) == (stamp.t_receive_ns, stamp.t_solved_ns)
        assert len(contacts[which].contacts) == len(field.contacts)
        for told, contact in zip(contacts[which].contacts, field.contacts, strict=True):
            assert told.normal_force == contact.normal_force_n
            assert [told.position.x, told.position.y, told.position.z] == contact.centroid_m.tolist()
            assert -told.force.z == pytest.approx(contact.normal_force_n, rel=1e-12)  # a flat patch
            pressed += 1
    assert pressed > 5


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _table(cloud: Any) -> Any:
    kinds = {"names": [f.name for f in cloud.fields], "formats": ["<f4"] * len(cloud.fields)}
    return np.frombuffer(cloud.data.tobytes(), dtype=kinds).reshape(cloud.height, cloud.width)


def decoded(path: Path) -> list[Any]:
    """All messages, as mcap-ros2-support reads them."""
    with path.open("rb") as file:
        return list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())


@pytest.mark.long
def test_mcap_ros2_support_reads_every_message_that_rosbags_reads(run: Any) -> None:
    path, *_ = run
    ours: Counter[str] = Counter()
    wrenches: list[tuple[float, float]] = []
    for item in decoded(path):
        ours[item.channel.topic] += 1
        if item.schema is not None and item.schema.name == "geometry_msgs/msg/WrenchStamped":
            wrench = item.decoded_message.wrench
            wrenches.append((wrench.force.z, wrench.torque.x))
    theirs: Counter[str] = Counter()
    read: list[tuple[float, float]] = []
    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            theirs[connection.topic] += 1
            if connection.msgtype == "geometry_msgs/msg/WrenchStamped":
                message: Any = bag.deserialize(raw, connection.msgtype)
                read.append((message.wrench.force.z, message.wrench.torque.x))
    assert ours == theirs
    kinds = {topic.rpartition("/")[2] for topic in ours}
    assert kinds >= {"from_can_bus", "to_can_bus", "field", "field_info", "contacts", "contact_wrenches"}
    assert kinds >= {"diagnostics", "tf_static", "events", "journal"}
    assert sorted(wrenches) == sorted(read) != []
    assert all(force_z < 0 for force_z, _ in wrenches)  # pressed into the skin


@pytest.mark.long
def test_a_wrench_acts_at_the_position_of_its_contact(run: Any) -> None:
    """The torque about the origin of the patch is the cross product of position and force."""
    path, *_ = run
    contacts, wrenches = [], []
    for item in decoded(path):
        name = "" if item.schema is None else item.schema.name
        if name == "skinnode_msgs/msg/Contacts":
            contacts += item.decoded_message.contacts
        elif name == "geometry_msgs/msg/WrenchStamped":
            wrenches.append(item.decoded_message.wrench)
    assert len(contacts) == len(wrenches) > 5
    for contact in contacts:
        r = np.array([contact.position.x, contact.position.y, contact.position.z])
        f = np.array([contact.force.x, contact.force.y, contact.force.z])
        torques = [[w.torque.x, w.torque.y, w.torque.z] for w in wrenches if w.force.z == contact.force.z]
        assert any(np.allclose(np.cross(r, f), each, rtol=1e-12, atol=1e-18) for each in torques)


def test_log_time_is_never_before_publish_time(run: Any) -> None:
    path, *_ = run
    with path.open("rb") as file:
        messages = [each for each in StreamReader(file).records if isinstance(each, Message)]
    late_ns = [each.log_time - each.publish_time for each in messages]
    assert min(late_ns) >= 0
    assert 0 < max(late_ns) < 5e9
    assert all(0 <= each.log_time - START_WALL_NS < 10e9 for each in messages)


FRAMES = [
    Frame(0x185, bytes(range(8)), 1_000_000_123),
    Frame(0x1ABCDE01, b"\x01", 1_002_000_000, extended=True),
    Frame(0x705, b"", 1_003_000_000, remote=True),
    Frame(0x4, b"\x01\x02", 1_003_500_000, error=True),
    Frame(0x186, bytes(range(64)), 1_004_000_000, fd=True),
    Frame(0x187, b"", 1_005_000_000, fd=True),
]


def test_frames_of_every_kind_come_back_with_every_nanosecond(tmp_path: Path) -> None:
    path, hand = tmp_path / "x.mcap", a_hand()
    with Recorder(hand, path) as recorder:
        recorder.received("can0", FRAMES)
        for frame in FRAMES:
            recorder.sent("can0", frame)
    offset_ns = replay(path).wall_minus_mono_ns
    back = [(g.frame._replace(t_ns=g.frame.t_ns - offset_ns), g.channel, g.sent) for g in McapReader(path)]
    assert back == [(f, "can0", sent) for sent in (False, True) for f in FRAMES]
    with AnyReader([path]) as bag:
        found = {
            (each.topic, each.msgtype, each.msgcount) for each in bag.connections if "can_bus" in each.topic
        }
    classic, fd = "can_msgs/msg/Frame", "ros2_socketcan_msgs/msg/FdFrame"
    assert found == {
        (f"{BASE}/can0/{name}{'_fd' if kind == fd else ''}", kind, count)
        for name in ("from_can_bus", "to_can_bus")
        for kind, count in ((classic, 4), (fd, 2))
    }


def test_can_frames_of_a_bag_that_another_program_recorded(tmp_path: Path) -> None:
    """Without compression, chunks or our metadata, as ros2_socketcan and rosbag2 may write them."""
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("can_msgs/msg/Frame", "ros2msg", b"")
        for number, topic in enumerate(("/can3/from_can_bus", "/can3/to_can_bus", "/other")):
            channel = writer.register_channel(topic, "cdr", schema)
            data = bytes.fromhex(
                "00010000 01000000 02000000 05000000 63616e30 00000000 85010000 00000008 0102030405060708"
            )
            writer.add_message(channel, number, data, number)
        writer.finish()
    frame = Frame(0x185, bytes(range(1, 9)), 1_000_000_002)
    assert list(McapReader(path)) == [(frame, "can3", False), (frame, "can3", True), (frame, "/other", False)]
    with pytest.raises(ConfigError, match=r"a skinnode recording; for other MCAP files .* give --hand"):
        replay(path)


def written(path: Path, frames: int, flush: int = 50) -> bytes:
    """A recording of so many frames, with a chunk for each ``flush`` frames."""
    from skinnode.record.journal import Header
    from skinnode.record.mcap_file import McapFile

    file = McapFile(path, a_hand())
    file.write_line(Header(a_hand(), "", 0).line(), 0)
    file.flush(to_disk=False)
    for number in range(frames):
        frame = Frame(0x185, number.to_bytes(8, "little"), 10**18 + number * 1000)
        file.write("can0", frame, sent=False, log_ns=frame.t_ns)
        if number % flush == flush - 1:
            file.flush(to_disk=False)
    file.close()
    return path.read_bytes()


def numbers_in(path: Path) -> tuple[list[int], int]:
    reader = McapReader(path)
    return [int.from_bytes(g.frame.data, "little") for g in reader], reader.damaged


def read_by_the_library(path: Path) -> int:
    """How many messages mcap's own reader gives before it stops at the cut."""
    messages = 0
    with path.open("rb") as file, contextlib.suppress(EndOfFile, ZstdError, struct.error, ValueError):
        for record in StreamReader(file).records:
            messages += isinstance(record, Message)
    return messages


@pytest.mark.long
def test_a_file_cut_anywhere_gives_every_whole_chunk(tmp_path: Path) -> None:
    whole, path = written(tmp_path / "x.mcap", 500), tmp_path / "cut.mcap"
    rng = random.Random(3)
    ends = sorted(rng.sample(range(8, len(whole)), 60))
    before = 0
    for end in ends:
        path.write_bytes(whole[:end])
        numbers, _ = numbers_in(path)
        assert numbers == list(range(len(numbers)))
        assert len(numbers) % 50 == 0
        assert len(numbers) >= before  # a longer file never gives less
        before = len(numbers)
        assert len(numbers) == max(read_by_the_library(path) - 1, 0)  # one message is the journal's
    assert before == 500


@pytest.mark.long
def test_garbage_costs_the_chunks_that_it_covers(tmp_path: Path) -> None:
    """Even if it claims a length, or that the data end here."""
    whole, path = written(tmp_path / "x.mcap", 500), tmp_path / "bad.mcap"
    middle = whole.index(b"zstd", len(whole) // 3) - 41
    assert whole[middle] == 6  # a chunk begins here
    end = b"\x0f\4\0\0\0\0\0\0\0\0\0\0\0"
    claims = [
        bytes([opcode]) + n.to_bytes(8, "little") for opcode in (3, 6, 7, 11, 200) for n in (0, 900, 9000)
    ]
    for seed in range(120):
        rng = random.Random(seed)
        garbage = rng.choice((b"\xff" * 30, bytes(30), end * 2, *claims, rng.randbytes(40)))
        at = middle + rng.choice((0, rng.randrange(2000)))
        path.write_bytes(whole[:at] + garbage + whole[at + len(garbage) :])
        numbers, damaged = numbers_in(path)
        assert len(numbers) >= 400, seed  # it covers parts of two chunks at most
        assert {0, 499} <= set(numbers)
        assert damaged or len(numbers) == 500
        assert numbers == sorted(set(numbers))


@pytest.mark.long
def test_whatever_is_in_a_file_nothing_but_one_line_is_raised(tmp_path: Path) -> None:
    whole, path = written(tmp_path / "x.mcap", 120, 30), tmp_path / "y.mcap"
    refusals: list[str] = []
    for seed in range(150):
        rng, content = random.Random(seed), bytearray(whole)
        for _ in range(rng.randint(1, 6)):
            at = rng.randrange(8, len(content))
            content[at : at + rng.randrange(30)] = rng.randbytes(rng.randrange(30))
        path.write_bytes(content)
        try:
            run = replay(path)
            assert list(run) == []
            assert len(run.flaws) > 0  # not ended properly, at least
        except ConfigError as error:
            refusals.append(str(error))
    assert not any("\n" in line for line in refusals)


def test_a_chunk_that_claims_little_and_contains_much_is_refused(tmp_path: Path) -> None:
    import zstandard
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk, Header

    path = tmp_path / "bomb.mcap"
    builder = RecordBuilder()
    Header("ros2", "x").write(builder)
    bomb = zstandard.compress(bytes(1 << 28))
    Chunk("zstd", bomb, 1, 0, 0, 1 << 20).write(builder)
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())
    assert numbers_in(path) == ([], 1)


@pytest.mark.parametrize(
    "content", [b"", b"x", b"\x89MCAP0\r", b"\x89MCAP0\r\n", b"(1.0) can0 5#\n", bytes(99)]
)
def test_a_file_of_another_kind_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    done = CliRunner().invoke(app, ["replay", str(path)])
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception).startswith(f"recording: got '{path}', allowed: a")
    assert "MCAP" in str(done.exception)


def test_a_newer_version_of_a_message_is_refused_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    whole = written(tmp_path / "old.mcap", 10)
    newer = DEFINITIONS[JOURNAL_LINE].replace("VERSION=1", "VERSION=2")
    file = io.BytesIO()
    writer = Writer(file)
    writer.start("ros2")
    schema = writer.register_schema(JOURNAL_LINE, "ros2msg", newer.encode())
    writer.add_message(writer.register_channel("/hand/journal", "cdr", schema), 0, b"\0\1\0\0", 0)
    writer.finish()
    path.write_bytes(file.getvalue())
    assert whole != file.getvalue()
    with pytest.raises(ConfigError) as refused:
        replay(path)
    assert str(refused.value) == (
        f"{path}: skinnode_msgs/msg/JournalLine: got version 2, "
        "allowed: version 1 or older; a newer skinnode can read this file"
    )


def test_a_missing_extra_is_one_line_with_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        "skinnode.messages.typestore.find_spec",
        lambda name: None if name == "rosbags" else find_spec(name),
    )
    with pytest.raises(ConfigError) as refused:
        Recorder(a_hand(), tmp_path / "x.mcap")
    assert str(refused.value) == (
        f"{tmp_path / 'x.mcap'}: got no package rosbags, "
        "allowed: the packages of the mcap extra (install: sh install.sh mcap)"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_the_command_tells_how_many_fields_it_wrote(tmp_path: Path) -> None:
    hand = a_hand()
    file, path = tmp_path / "hand.toml", tmp_path / "runs"
    sizes = "upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4"
    file.write_text(
        f'[[buses]]\nname = "can0"\ninterface = "timed"\nchannel = "{hand.buses[0].channel}"\n'
        f'[sync]\nperiod_ms = 50\n[[patches]]\nname = "p0"\nnode_id = 5\nlayout = {{ {sizes} }}\n'
    )
    from skinnode.config import load_hand

    with VirtualClock(), Fleet(load_hand(file)):
        options = ["record", str(file), "-o", str(path), "--format", "mcap", "--seconds", "1"]
        done = CliRunner().invoke(app, options)
    assert done.exit_code == 0, done.output
    (recording,) = path.iterdir()
    assert recording.suffix == ".mcap"
    (line,) = [each for each in done.output.splitlines() if "fields_dropped 0" in each]
    fields = int(line.split("fields ")[1].split()[0])
    with AnyReader([recording]) as bag:
        (cloud,) = [each for each in bag.connections if each.topic.endswith("/p0/field")]
    assert cloud.msgcount == fields > 5


@pytest.mark.long
@pytest.mark.timeout(600)
def test_killed_twenty_times_it_reads_up_to_the_last_second(tmp_path: Path) -> None:
    for attempt in range(20):
        path, repaired = tmp_path / f"run{attempt}.mcap", tmp_path / f"repaired{attempt}.mcap"
        with subprocess.Popen(
            [sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "go\n"
            time.sleep(random.Random(attempt).uniform(0.0, 2.0))
            child.send_signal(signal.SIGKILL)
            killed_ns = time.monotonic_ns()
            told = [line.split() for line in child.stdout.read().splitlines()]
        run = replay(path)
        assert not run.ended
        assert list(run) == []
        numbers, damaged = numbers_in(path)
        assert damaged <= 1  # the end of the file, if the process was writing
        assert numbers == list(range(len(numbers)))
        due = [int(each[0]) for each in told[:-1] if len(each) == 2 and int(each[1]) < killed_ns - 10**9]
        assert len(numbers) > max(due, default=-1)
        theirs = read_by_the_library(path)
        assert theirs == len(numbers) + 1
        done = CliRunner().invoke(app, ["convert", str(path), str(repaired)])
        assert done.exit_code == int(damaged > 0), done.output
        with AnyReader([repaired]) as bag:
            assert bag.message_count == theirs + 1  # and the journal line that tells of the repair


def test_readers_that_need_the_index_refuse_a_killed_file_and_take_the_repaired_one(tmp_path: Path) -> None:
    whole, path, repaired = written(tmp_path / "x.mcap", 500), tmp_path / "cut.mcap", tmp_path / "good.mcap"
    path.write_bytes(whole[: whole.rindex(b"zstd") - 41])  # as if killed after a flush
    with path.open("rb") as file, pytest.raises(Exception):  # noqa: B017, PT011 - whatever its bytes look like
        list(make_reader(file).iter_messages())
    with pytest.raises(Exception, match="File end magic is invalid"), AnyReader([path]):
        pass
    done = CliRunner().invoke(app, ["convert", str(path), str(repaired)])
    assert done.exit_code == 0, done.output
    with repaired.open("rb") as file:
        assert len(list(make_reader(file).iter_messages())) == len(numbers_in(path)[0]) + 2
    with AnyReader([repaired]) as bag:
        assert bag.message_count == len(numbers_in(path)[0]) + 2


@pytest.mark.long
def test_a_repaired_recording_is_whole_and_says_that_it_was_repaired(tmp_path: Path, run: Any) -> None:
    """Its replay has no fault, and the fields of the readable part of the original."""
    whole, cut, good, again = (tmp_path / f"{name}.mcap" for name in ("whole", "cut", "good", "again"))
    whole.write_bytes(run[0].read_bytes())
    convert(whole, tmp_path / "copy.mcap")
    assert replay(tmp_path / "copy.mcap").notes == ()
    data = whole.read_bytes()
    chunks = chunks_in(data)
    cut.write_bytes(data[: chunks[len(chunks) // 2]])
    killed = replay(cut)
    wanted = bits(killed)
    assert any("not ended properly" in flaw for flaw in killed.flaws)
    for source, target in ((cut, good), (good, again)):
        convert(source, target)
        played = replay(target)
        assert bits(played) == wanted
        assert (played.flaws, len(wanted) > 20) == ([], True)
        assert [note for note in played.notes if "was repaired" in note]


@pytest.mark.long
def test_a_changed_byte_in_an_index_hides_no_line_of_the_journal(tmp_path: Path) -> None:
    """Message indexes have no checksum; an index that is not believed costs time, not events."""
    path, hand = tmp_path / "x.mcap", a_hand()
    file = McapFile(path, hand)
    lines = [f"line {number}" for number in range(8)]
    for number, line in enumerate(lines):
        file.write_line(line, 1000 * number)
        file.write("can0", Frame(0x185, bytes(8), number), sent=False, log_ns=number)
        file.flush(to_disk=False)
        file.write("can0", Frame(0x185, bytes(8), number), sent=False, log_ns=number)
        file.flush(to_disk=False)
    file.close()
    data = path.read_bytes()
    at, changed = len(b"\x89MCAP0\r\n"), 0
    while at < len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        for byte in (at, at + 9) if data[at] in (0x07, 0x08) else ():  # message index, chunk index
            for value in (0, 1, 2, 3):
                bad = bytearray(data)
                bad[byte] = value
                path.write_bytes(bad)
                assert list(McapReader(path).journal()) == [f"{line}\n".encode() for line in lines]
                changed += 1
        at = end
    assert changed > 100


@pytest.mark.long
def test_a_copy_with_frames_only_has_no_messages_of_another_kind(tmp_path: Path, run: Any) -> None:
    path, small = run[0], tmp_path / "small.mcap"
    done = CliRunner().invoke(app, ["convert", str(path), str(small), "--frames-only", "--json"])
    assert done.exit_code == 0, done.output
    with small.open("rb") as file:
        kinds = Counter(schema.name for schema, _, _ in make_reader(file).iter_messages() if schema)
    assert set(kinds) == {FRAME, JOURNAL_LINE}
    assert json.loads(done.stdout)["frames"] == kinds[FRAME] > 500
    assert json.loads(done.stdout)["fields"] == 0
    assert bits(replay(small)) == bits(replay(path))


@pytest.mark.long
def test_a_repaired_recording_knows_that_a_part_is_missing_inside(tmp_path: Path, run: Any) -> None:
    """The numbers of frames in its journal no longer hold, so its events take effect by their times."""
    bad, good = tmp_path / "bad.mcap", tmp_path / "good.mcap"
    data = bytearray(run[0].read_bytes())
    data[middle_frames(run[0]) + 200] ^= 0xFF
    bad.write_bytes(data)
    done = convert(bad, good)
    assert any("cannot be read" in fault for fault in done.faults)
    damaged, repaired = replay(bad), replay(good)
    before, after = bits(damaged), bits(repaired)
    assert damaged.log.damaged == 1
    assert after[-10:] == before[-10:]
    assert [flaw for flaw in repaired.flaws if "frames, but" in flaw]


HOST = """
import sys, time
from skinnode.config import load_hand
from skinnode.host import Host
from skinnode.record import Recorder, followed
from vcan_sim.fleet import Fleet
hand = load_hand(sys.argv[1])
with Fleet(hand), Recorder(hand, sys.argv[2]) as recorder, Host.from_config(hand, tap=recorder) as host:
    with followed(recorder, host):
        print("go", flush=True)
        for field in host.fields():
            print(field.stamp.patch, field.stamp.scan, time.monotonic_ns(), flush=True)
"""


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_killed_host_leaves_the_fields_up_to_the_last_second(tmp_path: Path) -> None:
    hand = tmp_path / "hand.toml"
    sizes = "upper_wires = 4, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 4"
    hand.write_text(
        '[[buses]]\nname = "can0"\ninterface = "virtual"\n[sync]\nperiod_ms = 50\n'
        f'[[patches]]\nname = "p0"\nnode_id = 5\nlayout = {{ {sizes} }}\n'
    )
    for attempt in range(5):
        path, repaired = tmp_path / f"run{attempt}.mcap", tmp_path / f"repaired{attempt}.mcap"
        arguments = [sys.executable, "-c", HOST, str(hand), str(path)]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "go\n"
            time.sleep(random.Random(attempt).uniform(1.0, 3.0))
            child.send_signal(signal.SIGKILL)
            killed_ns = time.monotonic_ns()
            told = [line.split() for line in child.stdout.read().splitlines()]
        done = CliRunner().invoke(app, ["convert", str(path), str(repaired)])
        assert done.exit_code in (0, 1), done.output
        scans = set()
        with AnyReader([repaired]) as bag:
            for connection, _, raw in bag.messages():
                if connection.msgtype == "skinnode_msgs/msg/FieldInfo":
                    message: Any = bag.deserialize(raw, connection.msgtype)
                    scans.add((message.patch, message.scan))
        due = {(each[0], int(each[1])) for each in told[:-1] if int(each[2]) < killed_ns - 10**9}
        assert due
        assert due <= scans
        run = replay(path)
        assert {key(field) for field in run} >= due
        assert any("not ended properly" in flaw for flaw in run.flaws)
