"""Public names of the modules that define a patch's wire format.

The module ``codes`` converts resistances to codes. The modules ``chunk`` and ``summary`` pack and unpack PDO
payloads, and ``command`` packs and unpacks the host's commands. The modules ``scan_check`` and
``device_time`` compute the summary's scan check and device time, and ``self_test`` packs the record 0x2023.
None of the functions accesses a bus or a clock.
"""

from skinnode.protocol.chunk import (
    Chunk,
    chunk_indexer,
    chunk_of_code,
    pack_chunk,
    pack_scan,
    unpack_chunk,
    unpack_scan,
    unpack_scan_with_check,
)
from skinnode.protocol.codes import MISSING, Codes, CodeScale, Decoder, as_baseline, decode, encode
from skinnode.protocol.command import Command, SendMode, pack_command, unpack_command
from skinnode.protocol.device_time import TIME_STEP_US, TIME_WRAP_US, restore_time_us
from skinnode.protocol.payload import PDO_BYTES
from skinnode.protocol.scan_check import check_of_codes, scan_check
from skinnode.protocol.self_test import (
    SELF_TEST_NEVER_RUN,
    SelfTest,
    SelfTestFault,
    SelfTestStatus,
    pack_self_test,
)
from skinnode.protocol.summary import (
    Summary,
    SummaryFlag,
    conversion_phase,
    pack_checked_summary,
    pack_summary,
    pack_summary_record,
    unpack_summary,
)

__all__ = [
    "MISSING",
    "PDO_BYTES",
    "SELF_TEST_NEVER_RUN",
    "TIME_STEP_US",
    "TIME_WRAP_US",
    "Chunk",
    "CodeScale",
    "Codes",
    "Command",
    "Decoder",
    "SelfTest",
    "SelfTestFault",
    "SelfTestStatus",
    "SendMode",
    "Summary",
    "SummaryFlag",
    "as_baseline",
    "check_of_codes",
    "chunk_indexer",
    "chunk_of_code",
    "conversion_phase",
    "decode",
    "encode",
    "pack_checked_summary",
    "pack_chunk",
    "pack_command",
    "pack_scan",
    "pack_self_test",
    "pack_summary",
    "pack_summary_record",
    "restore_time_us",
    "scan_check",
    "unpack_chunk",
    "unpack_command",
    "unpack_scan",
    "unpack_scan_with_check",
    "unpack_summary",
]
