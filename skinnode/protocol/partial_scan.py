"""Decodes scans from which chunks are missing. Unsent chunks keep their last codes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.chunk import chunk_of_code, unpack_scan, unpack_scan_with_check
from skinnode.protocol.codes import MISSING, Codes
from skinnode.protocol.profile import PatchProfile


class HeldChunks:
    """Last known payloads of all chunks of a patch.

    Args:
        profile: Dimensions of the patch.
    """

    def __init__(self, profile: PatchProfile) -> None:
        self._profile = profile
        self._steps = (1 << profile.code_bits) - 4
        self._payloads: Sequence[bytes | None] = []
        self._decoded: tuple[Codes, NDArray[np.bool_], int | None] | None = None
        self.forget()

    def forget(self) -> None:
        """Discard all payloads after the loss of a scan that may have changed them."""
        self._payloads, self._decoded = [None] * self._profile.n_chunks, None

    def update(self, received: Sequence[bytes | None], *, carry: bool) -> None:
        """Store the payloads of a closed scan.

        Args:
            received: Payload of each chunk; None for a chunk that did not arrive.
            carry: Whether chunks that did not arrive are unchanged and keep their last payloads.
        """
        if carry and None in received:
            held = self._payloads
            received = [old if new is None else new for new, old in zip(received, held, strict=True)]
        self._payloads, self._decoded = received, None

    def decode(self) -> tuple[Codes, NDArray[np.bool_], int | None]:
        """Decode all stored payloads. Until the codes change, return the same read-only arrays.

        Returns:
            (U, K) codes, with :data:`~skinnode.protocol.codes.MISSING` where unknown; a (U, K) mask of the
            measurements; and the CRC over the codes
            (:func:`~skinnode.protocol.scan_check.check_of_codes`), or None if any code is unknown.
        """
        if self._decoded is None:
            self._decoded = self._decode()
        return self._decoded

    def _decode(self) -> tuple[Codes, NDArray[np.bool_], int | None]:
        profile = self._profile
        known = [payload for payload in self._payloads if payload is not None]
        blank = bytes(profile.chunk_bytes)
        check: int | None = None
        if len(known) == len(self._payloads):
            codes, check = unpack_scan_with_check(b"".join(known), profile)
        else:
            codes = unpack_scan(b"".join([payload or blank for payload in self._payloads]), profile)
            unknown = np.array([payload is None for payload in self._payloads])
            codes[unknown[chunk_of_code(profile)]] = MISSING
        valid = codes <= self._steps
        codes.setflags(write=False)
        valid.setflags(write=False)
        return codes, valid, check
