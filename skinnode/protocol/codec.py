"""Public names of the modules that implement the wire format of a patch.

- ``codes``: conversion between resistances and codes
- ``chunk``, ``summary``, ``command``: payloads of the PDOs
- ``scan_check``, ``device_time``: scan check and device time of a summary
- ``self_test``: record 0x2023
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
