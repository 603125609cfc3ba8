"""Packs and unpacks chunks. A chunk carries some of the codes of a scan and is sent in TPDO1."""

from __future__ import annotations

import binascii
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.canopen import indices as od
from skinnode.protocol.codes import Codes
from skinnode.protocol.payload import PDO_BYTES, require_length
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan_check import CRC_INITIAL

_COB_ID: Final = od.chunk_cob_id(0)


class Chunk(NamedTuple):
    """Contents of a chunk, as sent on a classic CAN bus."""

    chunk: int
    """Chunk index. The chunk begins with code ``chunk · codes_per_chunk`` of the scan."""
    scan: int
    """Scan counter, u8."""
    codes: tuple[int, ...]


def pack_chunk(chunk: int, scan: int, codes: Sequence[int], bits: int = 16) -> bytes:
    """Pack the payload of TPDO1.

    Args:
        chunk: Chunk index, 0 to 255.
        scan: Scan counter, 0 to 255.
        codes: Up to 3 codes of 16 bits, or 2 of 24 bits; unused bytes are set to 0.
        bits: Width of a code, 16 or 24.

    Raises:
        ValueError: If a value does not fit in its field or there are too many codes.
    """
    width = bits // 8
    if not (0 <= chunk <= 255 and 0 <= scan <= 255):
        raise ValueError(f"chunk, scan: got {chunk}, {scan}, must be from 0 to 255")
    try:
        body = b"".join(int(code).to_bytes(width, "little") for code in codes)
    except OverflowError:
        raise ValueError(f"codes: got {list(codes)}, must be from 0 to {(1 << bits) - 1}") from None
    if len(body) > PDO_BYTES - 2:
        raise ValueError(f"codes: got {len(codes)} of {bits} bits, must be at most {6 // width}")
    return bytes((chunk, scan)) + body.ljust(PDO_BYTES - 2, b"\0")


def unpack_chunk(data: bytes, bits: int = 16, *, cob_id: int = _COB_ID) -> Chunk:
    """Unpack the payload of TPDO1.

    Args:
        data: Payload of the frame.
        bits: Width of a code, 16 or 24.
        cob_id: COB-ID for the error message.

    Raises:
        CodecError: If the payload is not 8 bytes long.
    """
    require_length(data, PDO_BYTES, cob_id, "chunk")
    width = bits // 8
    codes = tuple(int.from_bytes(data[at : at + width], "little") for at in range(2, PDO_BYTES, width))
    return Chunk(data[0], data[1], codes)


def pack_scan(
    codes: ArrayLike, scan: int, profile: PatchProfile, only: Sequence[int] | None = None
) -> list[bytes]:
    """Return the payloads of the chunks of a scan, in sending order.

    Args:
        codes: (U, K) codes.
        scan: Scan counter, 0 to 255.
        profile: Dimensions of the patch.
        only: Chunks to pack, numbered as in :func:`chunk_of_code`, in sending order; None for all chunks.

    Raises:
        ValueError: If the shape is wrong or a code to pack has more bits than ``profile`` allows.
    """
    array = np.asarray(codes, dtype=np.uint32)
    if array.shape != (profile.rows, profile.columns):
        raise ValueError(f"codes: got shape {array.shape}, must be ({profile.rows}, {profile.columns})")
    if only is not None and not len(only):
        return []
    if int(array.max()) >> profile.code_bits:
        raise ValueError(f"codes: got {int(array.max())}, must be below {1 << profile.code_bits}")
    width, per, size, n = (
        profile.code_bits // 8,
        profile.codes_per_chunk,
        profile.chunk_bytes,
        profile.n_chunks,
    )
    lines = array.reshape(profile.lines, -1)
    padded = np.zeros((profile.lines, profile.chunks_per_line * per), dtype="<u4")
    padded[:, : lines.shape[1]] = lines
    frames = _empty_chunks(profile).copy()
    frames[:, 1] = scan
    head = profile.chunk_head_bytes
    frames[:, head : head + per * width] = padded.view(np.uint8).reshape(-1, 4)[:, :width].reshape(n, -1)
    payload = frames.tobytes()
    return [payload[at * size : (at + 1) * size] for at in (range(n) if only is None else only)]


@functools.cache
def _empty_chunks(profile: PatchProfile) -> NDArray[np.uint8]:
    """Return (chunks, bytes) payloads in which the scan counter and the codes are still zero."""
    n = profile.n_chunks
    chunks = np.zeros((n, profile.chunk_bytes), dtype=np.uint8)
    if profile.bus == "classic":
        chunks[:, 0] = np.arange(n)
    else:
        wire, part = np.divmod(np.arange(n), profile.chunks_per_line)
        chunks[:, 0] = wire
        chunks[:, 2:4] = (part * profile.codes_per_chunk).astype("<u2")[:, None].view(np.uint8)
    return chunks


def unpack_scan(frames: bytes, profile: PatchProfile) -> Codes:
    """Return the (U, K) codes of a scan, given the payloads of its chunks.

    Args:
        frames: Payloads of all chunks in ascending order, concatenated.
        profile: Dimensions of the patch.
    """
    return unpack_scan_with_check(frames, profile)[0]


def unpack_scan_with_check(frames: bytes, profile: PatchProfile) -> tuple[Codes, int]:
    """Return the codes of a scan and the CRC over them.

    Args:
        frames: Payloads of all chunks in ascending order, concatenated.
        profile: Dimensions of the patch.

    Returns:
        (U, K) codes, and the CRC over them (:func:`~skinnode.protocol.scan_check.check_of_codes`).
    """
    places = _places_of_codes(profile)
    if profile.code_bits == 16:
        narrow = np.frombuffer(frames, "<u2").take(places)
        return narrow.astype(np.uint32), binascii.crc_hqx(narrow.tobytes(), CRC_INITIAL)
    wide = np.frombuffer(frames + b"\0", np.uint8).take(places)
    codes: Codes = wide.view("<u4")[:, :, 0]
    return codes, binascii.crc_hqx(wide[:, :, :3].tobytes(), CRC_INITIAL)


@functools.lru_cache(maxsize=64)
def _places_of_codes(profile: PatchProfile) -> NDArray[np.intp]:
    """Return the position of each code in the concatenated payloads of a scan.

    16-bit codes: (U, K) positions in 16-bit words. 24-bit codes: (U, K, 4) positions in bytes; the fourth
    byte is the zero byte that :func:`unpack_scan_with_check` appends to the payloads.
    """
    width, per, head = profile.code_bits // 8, profile.codes_per_chunk, profile.chunk_head_bytes
    lines, shape = profile.lines, (profile.rows, profile.columns)
    numbers = np.arange(profile.n_chunks * profile.chunk_bytes).reshape(profile.n_chunks, -1)
    first = numbers[:, head : head + per * width : width].reshape(lines, -1)  # byte of each code
    first = first[:, : profile.n_codes // lines].reshape(shape)
    if width == 2:
        return first // 2
    return np.stack([first, first + 1, first + 2, np.full(shape, numbers.size)], axis=-1)


@functools.lru_cache(maxsize=64)
def chunk_of_code(profile: PatchProfile) -> NDArray[np.intp]:
    """Return the (U, K) chunk numbers of the codes, counted from 0 in sending order."""
    lines, per_line = profile.lines, profile.n_codes // profile.lines
    within = np.arange(per_line) // profile.codes_per_chunk
    chunks = np.arange(lines)[:, None] * profile.chunks_per_line + within
    chunks = chunks.reshape(profile.rows, profile.columns)
    chunks.setflags(write=False)
    return chunks


def chunk_indexer(profile: PatchProfile) -> Callable[[bytes], int]:
    """Return a function that reads a chunk's number (:func:`chunk_of_code`) from its payload.

    The function returns ``n_chunks`` or more if the patch has no such chunk. The length of the payload must
    already have been checked.
    """
    if profile.bus == "classic":
        return operator.itemgetter(0)
    rows, columns, n = profile.rows, profile.columns, profile.n_chunks
    per, per_line = profile.codes_per_chunk, profile.chunks_per_line

    def index(data: bytes) -> int:
        column = data[2]
        # A patch has fewer than 256 columns, so the upper byte of the first column must be 0.
        if data[0] >= rows or data[3] or column >= columns or column % per:
            return n
        return data[0] * per_line + column // per

    return index
