"""Decodes partial scans, in which unsent chunks keep their last codes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skinnode.protocol.chunk import chunk_of_code, unpack_scan, unpack_scan_with_check
from skinnode.protocol.codes import MISSING, Codes
from skinnode.protocol.profile import PatchProfile


class HeldChunks:
    """Stores the last known payload of each of a patch's chunks.

    Args:
        profile: sizes of the patch.
    """

    def __init__(self, profile: PatchProfile) -> None:
        self._profile = profile
        self._steps = (1 << profile.code_bits) - 4
        self._payloads: Sequence[bytes | None] = []
        self.forget()

    def forget(self) -> None:
        """Discard all payloads, as required after a missed scan, which may have changed the codes."""
        self._payloads = [None] * self._profile.n_chunks

    def update(self, received: Sequence[bytes | None], *, carry: bool) -> None:
        """Store the payloads of a scan after its last frame.

        Args:
            received: payload of each chunk; None for a chunk that did not arrive.
            carry: whether chunks that did not arrive are unchanged and keep their last payloads.
        """
        if carry and None in received:
            held = self._payloads
            received = [old if new is None else new for new, old in zip(received, held, strict=True)]
        self._payloads = received

    def decode(self) -> tuple[Codes, NDArray[np.bool_], int | None]:
        """Decode all stored payloads.

        Returns:
            (U, K) codes, a (U, K) mask of the measurements, and the CRC over the codes
            (:func:`~skinnode.protocol.scan_check.check_of_codes`). The CRC is None if any payload is unknown.
        """
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
