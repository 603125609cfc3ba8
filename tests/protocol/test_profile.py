"""The object dictionary against CiA 301 and the canopen library; the EDS against two independent parsers."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import canopen
import dcf
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from skinnode.canopen import indices as od
from skinnode.canopen.dictionary import DataType, Entry, ObjectType
from skinnode.cli.eds import eds
from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.protocol.chunk import pack_scan
from skinnode.protocol.command import pack_command
from skinnode.protocol.eds_files import REFERENCE_PROFILES, dcf_text, eds_name, eds_text
from skinnode.protocol.profile import DEFAULT_PERIOD_MS, PatchProfile
from skinnode.protocol.summary import pack_checked_summary, pack_summary
from tests.lanes import some_long

EDS = Path(__file__).parents[2] / "eds"
NODE_ID = 5
PROFILES = [
    *REFERENCE_PROFILES,
    PatchProfile(1, 1, 1, 1, 16),
    PatchProfile(33, 7, 255, 255, 24),
    PatchProfile(3, 254, 1, 1, 16),
    PatchProfile(3, 61, 1, 1, 24, bus="fd"),
]


def load(text: str) -> canopen.ObjectDictionary:
    file = io.StringIO(text)
    file.name = "patch.eds"
    return canopen.import_od(file, NODE_ID)


def entries(profile: PatchProfile) -> dict[tuple[int, int], Entry]:
    return {(e.index, e.subindex): e for item in profile.objects() for e in item.entries}


@pytest.fixture(params=PROFILES, ids=eds_name)
def profile(request: pytest.FixtureRequest) -> PatchProfile:
    return request.param


by_few_profiles = pytest.mark.parametrize(
    "profile", some_long(PROFILES, PROFILES[0], PROFILES[-1]), ids=eds_name
)
"""For tests that let another program read the file: a plain run has a classic profile and one of CAN FD."""


# --- the files


@pytest.mark.parametrize("reference", REFERENCE_PROFILES, ids=eds_name)
def test_the_reference_file_is_what_is_generated(reference: PatchProfile) -> None:
    assert (EDS / eds_name(reference)).read_bytes() == eds_text(reference).encode("ascii"), (
        "run: python -m skinnode.protocol.profile eds/"
    )


def test_eds_holds_the_reference_files_and_nothing_else() -> None:
    assert {file.name for file in EDS.iterdir()} == {eds_name(reference) for reference in REFERENCE_PROFILES}


@pytest.mark.long
@by_few_profiles
def test_dcfchk_accepts_the_eds_without_a_word(profile: PatchProfile, tmp_path: Path) -> None:
    file = tmp_path / eds_name(profile)
    file.write_text(eds_text(profile))
    tool = shutil.which("dcfchk", path=str(Path(sys.executable).parent)) or shutil.which("dcfchk")
    assert tool is not None, "dcfchk of dcf-tools is missing"
    done = subprocess.run([tool, "-n", str(NODE_ID), str(file)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_canopen_reads_every_entry_as_it_is_meant(profile: PatchProfile) -> None:
    loaded, meant = load(eds_text(profile)), entries(profile)
    found = {}
    for index in loaded:
        item = loaded[index]
        members = item.values() if isinstance(item, canopen.objectdictionary.ODRecord) else None
        if isinstance(item, canopen.objectdictionary.ODArray):
            members = [item[sub] for sub in item]
        for variable in members or [item]:
            found[variable.index, variable.subindex] = variable
    assert found.keys() - {(data_type, 0) for data_type in range(2, 8)} == meant.keys()  # dummy entries
    for key, entry in meant.items():
        variable = found[key]
        assert variable.data_type == entry.data_type, key
        assert variable.access_type == entry.access, key
        assert variable.pdo_mappable == entry.mappable, key
        assert (variable.min, variable.max) == (entry.low, entry.high), key
        if entry.data_type is not DataType.REAL32:
            assert variable.default == entry.value_at_start(NODE_ID), key
        if entry.data_type.bits:
            assert len(variable) in (entry.data_type.bits, 32), key  # the library keeps U24 in 32 bits


@by_few_profiles
def test_dcf_tools_read_every_default_as_it_is_meant(profile: PatchProfile, tmp_path: Path) -> None:
    file = tmp_path / "patch.eds"
    file.write_text(eds_text(profile))
    device = dcf.Device.from_dcf(str(file), {"NODEID": NODE_ID})
    for (index, subindex), entry in entries(profile).items():
        loaded = device[index][subindex]
        assert loaded.data_type.index == entry.data_type
        if entry.default is not None and entry.data_type.bits:
            assert loaded.parse_value() == entry.value_at_start(NODE_ID), (hex(index), subindex)
    assert device[od.DESCRIPTOR][od.CODE_LO].parse_value() == 0.25
    assert device[od.DESCRIPTOR][od.CODE_HI].parse_value() == 1.25


def test_the_head_names_the_device() -> None:
    information = load(eds_text(REFERENCE_PROFILES[0])).device_information
    assert information.vendor_number == od.VENDOR_ID == 0
    assert information.product_number == od.PRODUCT_CODE
    assert information.revision_number == od.REVISION_NUMBER
    assert information.allowed_baudrates == {125_000, 250_000, 500_000, 1_000_000}
    assert (information.nr_of_RXPDO, information.nr_of_TXPDO) == (4, 4)
    assert information.LSS_supported


# --- what CiA 301 prescribes


def test_cob_ids_are_the_predefined_connection_set() -> None:
    loaded = load(eds_text(REFERENCE_PROFILES[0]))
    for variable, written, cob_id in (
        (loaded[0x1005], "0x00000080", 0x80),
        (loaded[0x1014], "$NODEID+0x80", 0x85),
        (loaded[0x1200][1], "$NODEID+0x600", 0x605),
        (loaded[0x1200][2], "$NODEID+0x580", 0x585),
        (loaded[0x1400][1], "$NODEID+0x200", 0x205),
        (loaded[0x1800][1], "$NODEID+0x180", 0x185),
        (loaded[0x1801][1], "$NODEID+0x280", 0x285),
    ):
        assert (variable.default_raw, variable.default) == (written, cob_id)
    assert od.emcy_cob_id(NODE_ID) == 0x85
    assert od.chunk_cob_id(NODE_ID) == 0x185
    assert od.command_cob_id(NODE_ID) == 0x205
    assert od.summary_cob_id(NODE_ID) == 0x285
    assert od.sdo_response_cob_id(NODE_ID) == 0x585
    assert od.sdo_request_cob_id(NODE_ID) == 0x605
    assert od.heartbeat_cob_id(NODE_ID) == 0x705


def test_every_object_asked_for_is_there_with_its_type() -> None:
    types = {item.index: item.type for item in REFERENCE_PROFILES[0].objects()}
    var, array, record = ObjectType.VAR, ObjectType.ARRAY, ObjectType.RECORD
    expected = dict.fromkeys((0x1000, 0x1001, 0x1005, 0x1006, 0x1007, 0x1008, 0x1009, 0x100A, 0x100C), var)
    expected |= dict.fromkeys((0x100D, 0x1012, 0x1014, 0x1015, 0x1017, 0x1019), var)
    expected |= dict.fromkeys((0x1003, 0x1010, 0x1011, 0x1016, 0x1020, 0x1029), array)
    expected |= dict.fromkeys((0x1018, 0x1200), record)
    pdos = (base + number for base in (0x1400, 0x1600, 0x1800, 0x1A00) for number in range(4))
    expected |= dict.fromkeys(pdos, record)
    expected |= dict.fromkeys((0x2000, 0x2010, 0x2011, 0x2020, 0x2021, 0x2022, 0x2023), record)
    expected |= dict.fromkeys((0x2030, 0x2031, 0x2040, *range(0x2100, 0x210A), *range(0x2200, 0x220A)), array)
    expected |= dict.fromkeys((0x2300, 0x2301), ObjectType.DOMAIN)
    assert types == expected


def test_indices_and_subindices_ascend_and_names_are_unique(profile: PatchProfile) -> None:
    items = profile.objects()
    indices = [item.index for item in items]
    assert indices == sorted(set(indices))
    assert len({item.name for item in items}) == len(items)  # the canopen library looks objects up by name
    for item in items:
        subindices = [entry.subindex for entry in item.entries]
        assert subindices == sorted(set(subindices))
        assert subindices[0] == 0
        assert subindices[-1] <= 254
        assert all(entry.index == item.index for entry in item.entries)
        assert len({entry.name for entry in item.entries}) == len(item.entries)
        if item.type in (ObjectType.ARRAY, ObjectType.RECORD):
            assert item.entries[0].data_type is DataType.UNSIGNED8
            if item.index != 0x1003 and item.index >> 8 not in (
                0x16,
                0x1A,
            ):  # there sub-index 0 counts what is in use
                assert item.entries[0].default == subindices[-1]


@pytest.mark.parametrize("index", [0x1600, 0x1A00, 0x1A01])
def test_default_mappings_name_mappable_entries_of_the_right_length(
    profile: PatchProfile, index: int
) -> None:
    known = entries(profile)
    count = known[index, 0].default
    slots = 64 if profile.bus == "fd" else 8
    mapped = [known[index, sub].default for sub in range(1, slots + 1)]
    assert (index, slots + 1) not in known
    bits = 0
    for value in mapped[:count]:
        entry = known[value >> 16, value >> 8 & 0xFF]
        assert entry.mappable
        assert value & 0xFF == entry.data_type.bits
        assert entry.access == ("rww" if index == 0x1600 else "ro")
        bits += value & 0xFF
    assert mapped[count:] == [0] * (slots - count)
    chunk = 8 * profile.chunk_bytes
    if profile.bus == "fd":  # before padding
        chunk = 32 + profile.codes_per_chunk * profile.code_bits
    assert bits == {0x1600: 48, 0x1A00: chunk, 0x1A01: 64}[index]


@pytest.mark.parametrize("reference", REFERENCE_PROFILES, ids=eds_name)
def test_canopen_decodes_our_payloads_through_the_default_mapping(reference: PatchProfile) -> None:
    node = canopen.Network().add_node(canopen.RemoteNode(NODE_ID, load(eds_text(reference))))
    node.tpdo.read(from_od=True)
    node.rpdo.read(from_od=True)
    chunk, summary, command = node.tpdo[1], node.tpdo[2], node.rpdo[1]
    scan = np.random.default_rng(1).integers(0, 1 << reference.code_bits, (10, 30))
    payload, per = pack_scan(scan, 200, reference)[9], reference.codes_per_chunk
    chunk.data = bytearray(payload)
    if reference.bus == "classic":
        head, codes = [9, 200], scan.ravel()[9 * per : 10 * per].tolist()
    else:
        wire, first = (9, 0) if per == 30 else (4, 15)
        head, codes = [wire, 200, first], scan[wire, first : first + per].tolist()
    summary.data = bytearray(pack_checked_summary(200, 3, 77, 0xDEADBEEF, 0x1234))
    command.data = bytearray(pack_command(tare=True, single_scan=True))
    assert [(v.index, v.subindex, v.raw) for v in chunk] == [
        (0x2010, sub, value) for sub, value in enumerate([*head, *codes], 1)
    ]
    check = int.from_bytes(summary.data[6:], "little")
    assert [v.raw for v in summary] == [200, 0x23, 77, 0xDEADBEEF >> 6 & 0xFFFF, check]
    assert [(v.index, v.subindex, v.raw) for v in command] == [
        (0x2021, 4, od.TARE_SIGNATURE),
        (0x2021, 5, 1),
        (0x2020, 1, 0),
    ]
    assert (chunk.cob_id, chunk.trans_type, chunk.inhibit_time) == (
        0x185,
        254,
        reference.default_inhibit_100us,
    )
    assert (summary.cob_id, summary.trans_type) == (0x285, 1)
    assert (command.cob_id, command.trans_type) == (0x205, 255)


@pytest.mark.parametrize("reference", REFERENCE_PROFILES, ids=eds_name)
def test_a_patch_of_revision_1_0_maps_32_bits_of_time_and_has_no_check(reference: PatchProfile) -> None:
    old = replace(reference, checked=False)
    node = canopen.Network().add_node(canopen.RemoteNode(NODE_ID, load(eds_text(old))))
    node.tpdo.read(from_od=True)
    node.tpdo[2].data = bytearray(pack_summary(200, 3, 77, 0xDEADBEEF))
    assert [v.raw for v in node.tpdo[2]] == [200, 3, 77, 0xDEADBEEF]
    assert node.object_dictionary[0x1018][3].default == 0x0001_0000
    assert len(node.object_dictionary[0x2011]) == 5  # sub-index 0 and four
    others = (0x1018, 0x1A01, 0x2011)
    assert [o for o in old.objects() if o.index not in others] == [
        o for o in reference.objects() if o.index not in others
    ]


# --- sizes


def test_chunks_hold_three_narrow_or_two_wide_codes() -> None:
    narrow, wide = REFERENCE_PROFILES[:2]
    assert (narrow.n_codes, narrow.codes_per_chunk, narrow.n_chunks) == (300, 3, 100)
    assert (wide.n_codes, wide.codes_per_chunk, wide.n_chunks) == (300, 2, 150)
    assert PatchProfile(1, 4, 1, 1).n_chunks == 2


def test_a_profile_has_the_sizes_of_its_layout() -> None:
    layout = PatchLayout.preset(
        "aligned", upper_wires=2, upper_electrodes=3, lower_wires=11, lower_electrodes=4
    )
    assert PatchProfile.from_layout(layout, 24) == PatchProfile(2, 11, 3, 4, 24)


@pytest.mark.parametrize("reference", PROFILES, ids=eds_name)
def test_a_full_scan_paced_by_default_fits_the_default_period(reference: PatchProfile) -> None:
    frames_ms = reference.n_chunks * reference.default_inhibit_100us / 10
    assert frames_ms <= 0.9 * DEFAULT_PERIOD_MS


@pytest.mark.parametrize(
    ("sizes", "key"),
    [
        ((0, 30, 10, 10, 16), "rows"),
        ((10, 255, 10, 10, 16), "columns"),
        ((10, 30, 256, 10, 16), "upper_electrodes"),
        ((10, 30, 10, 0, 16), "lower_electrodes"),
        ((10, 30, 10, 10, 12), "code_bits"),
        ((10, 77, 10, 10, 16), "rows × columns"),  # 770 codes, 257 chunks
        ((10, 52, 10, 10, 24), "rows × columns"),
    ],
)
def test_sizes_the_wire_cannot_carry_are_refused(sizes: tuple[int, int, int, int, int], key: str) -> None:
    with pytest.raises(ConfigError, match="allowed") as caught:
        PatchProfile(*sizes)
    assert caught.value.key == key


# --- the command


def command(*arguments: str) -> object:
    app = typer.Typer()
    app.command()(eds)
    return CliRunner().invoke(app, list(arguments))


def test_the_command_prints_the_eds_of_the_sizes_asked_for() -> None:
    result = command(
        "--upper-wires=3",
        "--upper-electrodes=4",
        "--lower-wires=12",
        "--lower-electrodes=5",
        "--code-bits=24",
    )
    assert result.exit_code == 0
    assert result.output == eds_text(PatchProfile(3, 12, 4, 5, 24))


def test_the_command_writes_the_very_reference_file(tmp_path: Path) -> None:
    file = tmp_path / "patch.eds"
    assert command("--output", str(file)).exit_code == 0
    assert file.read_bytes() == (EDS / "skinnode-10x30-u16.eds").read_bytes()


def test_the_command_refuses_what_the_wire_cannot_carry() -> None:
    assert isinstance(command("--upper-wires=200", "--lower-wires=200").exception, ConfigError)
    assert isinstance(command("--code-bits=12").exception, ConfigError)
    assert command("--upper-wires=0").exit_code == 2


def test_the_command_prints_a_dcf() -> None:
    result = command("--dcf", "--node-id=9", "--bitrate=500000", "--fd", "--code-bits=24")
    assert result.exit_code == 0
    assert result.output == dcf_text(REFERENCE_PROFILES[3], 9, 500_000)


def test_the_command_takes_the_sizes_of_a_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "patch.toml"
    file.write_text('preset = "aligned"\nupper_wires = 3\nupper_electrodes = 4\nlower_electrodes = 5\n')
    assert command("--layout", str(file)).output == eds_text(PatchProfile(3, 12, 4, 5))
    assert command("--layout=symmetric", "--fd").output == eds_text(REFERENCE_PROFILES[2])
    (tmp_path / "my_layouts.py").write_text(
        "import numpy as np\nfrom skinnode import PatchLayout\n\n"
        "def odd():\n    lower = np.zeros((5, 2, 3))\n    lower[..., 2] = -1e-3\n"
        "    return PatchLayout(np.zeros((7, 3, 3)), lower)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert command("--layout=my_layouts:odd").output == eds_text(PatchProfile(7, 5, 3, 2))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--dcf"], "--node-id: got nothing, allowed: a node-ID from 1 to 127 for the DCF"),
        (["--node-id=4"], "--node-id: got 4, allowed: only with --dcf"),
        (["--bitrate=500000"], "--bitrate: got 500000, allowed: only with --dcf"),
        (["--layout=aligned", "--lower-wires=4"], "--lower-wires: got 4, allowed: only without --layout"),
        (
            ["--layout=wavy"],
            "--layout: got 'wavy', allowed: aligned, symmetric, staggered, FILE.toml, FILE.npz or",
        ),
        (["--layout=no.toml"], "layout file: got 'no.toml', allowed: a file that can be read"),
        (["--layout=json:dumps"], "--layout: got 'json:dumps', allowed: a function that returns a layout"),
        (["--layout=os:getcwd"], "--layout: got 'os:getcwd', allowed: a PatchLayout, or a function"),
        (["--layout=nowhere:x"], "--layout: got 'nowhere:x', allowed: MODULE:NAME that can be imported"),
        (["--output=/no/such/folder/x.eds"], "--output: got '/no/such/folder/x.eds', allowed: a file in an"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    error = command(*arguments).exception
    assert isinstance(error, ConfigError)
    assert str(error).startswith(says)
    assert "\n" not in str(error)


def test_a_layout_file_is_read_strictly(tmp_path: Path) -> None:
    file = tmp_path / "patch.toml"
    for text, says in (
        (
            "pitch = 1",
            ":1:1: pitch: got an unknown key, allowed: a key of this table (did you mean pitch_m?)",
        ),
        ("upper_wires = 0", ":1:1: upper_wires: got 0, allowed: an integer from 1 to 254"),
        ("upper_wires = = 3", ": line 1, column 15: got 'upper_wires = = 3', allowed: TOML"),
    ):
        file.write_text(text)
        error = command("--layout", str(file)).exception
        assert str(error).startswith(f"{file}{says}")
