"""Emergencies in words."""

from __future__ import annotations

import pytest

from skinnode.canopen.emergency import EmcyCode, error_text, history_text, register_text


def test_every_code_of_the_node_has_words_of_its_own() -> None:
    texts = {error_text(code, ours=True) for code in EmcyCode}
    assert len(texts) == len(EmcyCode)


@pytest.mark.parametrize(
    ("code", "detail", "text"),
    [
        (0x5000, "02 07 03 00", "wire open or shorted: lower wire open 7, 3 wires in total"),
        (0x5000, "01 00", "wire open or shorted: upper wire shorted 0"),
        (0x8130, "2a 00", "heartbeat or guarding lost: node 42"),
        (0x8130, "00 00", "heartbeat or guarding lost: master"),
        (0x8110, "05 01 00 00 00", "overrun: messages or scans lost: 261 scans skipped so far"),
        (
            0x8110,
            "01 00 01",
            "overrun: messages or scans lost: 1 scan skipped so far "
            "because the computer running the node is too slow",
        ),
        (0x8110, "00 00 01 00 00", "overrun: messages or scans lost"),  # emergencies, not scans
        (0x8150, "0b 07", "CAN-ID collision: another node has this node-ID: 0x70B"),
        (0x8250, "02 00", "RPDO timed out: RPDO2"),
        (0x8210, "02 01 06 00 00", "PDO not processed: too short: RPDO2, 1 byte instead of 6"),
        (0x8210, "2c 01 06 01 00", "PDO not processed: too short: RPDO300, 1 byte instead of 6"),
        (0x3210, "", "voltage inside"),
        (0x2F00, "", "error of class 0x2000"),
    ],
)
def test_words(code: int, detail: str, text: str) -> None:
    assert error_text(code, bytes.fromhex(detail), ours=True) == text


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x5000, "hardware"),
        (0x6300, "data set"),
        (0x8110, "CAN overrun: messages lost"),
        (0x8130, "heartbeat or guarding lost"),
        (0x8200, "protocol"),
        (0x8210, "PDO not processed: wrong length"),
        (0xFF00, "device-specific"),
    ],
)
def test_codes_of_other_makers_have_the_words_of_the_standard(code: int, text: str) -> None:
    assert error_text(code, b"\x01\x02\x03\x04\x05", ours=False) == text


def test_history_of_others_has_no_words_for_their_detail() -> None:
    assert history_text(0x0702_5000, ours=True) == "0x5000 wire open or shorted: lower wire open 7"
    assert history_text(0x0702_5000, ours=False) == "0x5000 hardware (manufacturer-specific: 0x0702)"
    assert history_text(0x0000_5000, ours=False) == "0x5000 hardware"


def test_register() -> None:
    assert register_text(0) == "no error"
    assert register_text(0x91) == "generic, communication, manufacturer-specific"
