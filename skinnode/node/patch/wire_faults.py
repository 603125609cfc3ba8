"""Open and shorted wires, found in the codes of a scan and reported by EMCY 0x5000."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.canopen.emergency import EmcyCode
from skinnode.node.emcy import EmcyProducer
from skinnode.protocol.codes import Codes, CodeScale
from skinnode.protocol.profile import PatchProfile

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class WireFaults:
    """Wires that have no usable crossing."""

    upper_open: Mask
    """(U,) upper wires that are open."""
    upper_short: Mask
    """(U,) upper wires that are shorted."""
    lower_open: Mask
    """(K,) lower wires that are open."""
    lower_short: Mask
    """(K,) lower wires that are shorted."""

    @classmethod
    def none(cls, profile: PatchProfile) -> WireFaults:
        """Return the result for a patch without wire faults."""
        rows, columns = np.zeros(profile.rows, dtype=np.bool_), np.zeros(profile.columns, dtype=np.bool_)
        return cls(rows, rows, columns, columns)

    @property
    def masks(self) -> tuple[Mask, Mask, Mask, Mask]:
        """Masks in the order upper open, upper shorted, lower open, lower shorted."""
        return self.upper_open, self.upper_short, self.lower_open, self.lower_short

    @property
    def any(self) -> bool:
        """Whether any wire is faulty."""
        return any(mask.any() for mask in self.masks)


def find_faults(codes: Codes, scale: CodeScale) -> WireFaults:
    """Return the wires whose crossings are all open, or all shorted.

    Args:
        codes: (U, K) codes.
        scale: the mapping of R/R0 to codes.
    """
    is_open, is_short = codes == scale.open, codes == scale.short
    return WireFaults(is_open.all(axis=1), is_short.all(axis=1), is_open.all(axis=0), is_short.all(axis=0))


class WireFaultReporter:
    """Reporter of the start and the end of wire faults.

    Args:
        profile: sizes of the patch.
        emcy: emergency producer.
    """

    def __init__(self, profile: PatchProfile, emcy: EmcyProducer) -> None:
        self._profile, self._emcy = profile, emcy
        self._reported = WireFaults.none(profile)

    def reset(self) -> None:
        """Forget the reported faults after a reset."""
        self._reported = WireFaults.none(self._profile)

    def report(self, faults: WireFaults, t_ns: int) -> None:
        """Send one message with the first new fault (kind and wire number) and the number of faulty wires.

        A pulled connector is one event, so it causes one message.

        Args:
            faults: current faults.
            t_ns: current time, ns.
        """
        reported, self._reported = self._reported, faults
        if not faults.any:
            self._emcy.clear(EmcyCode.HARDWARE, t_ns)
            return
        count = sum(int(mask.sum()) for mask in faults.masks)
        for kind, (now, before) in enumerate(zip(faults.masks, reported.masks, strict=True)):
            new = now & ~before
            if new.any():
                detail = struct.pack("<BBH", kind, int(new.argmax()), count)
                self._emcy.report(EmcyCode.HARDWARE, detail, t_ns)
                return
