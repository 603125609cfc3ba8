"""Detects open and shorted wires from the codes of a scan and reports them with EMCY 0x5000."""

from __future__ import annotations

import functools
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinnode.canopen.emergency import EmcyCode
from skinnode.node.emcy import EmcyProducer
from skinnode.protocol.codes import Codes, CodeScale
from skinnode.protocol.profile import PatchProfile

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class WireFaults:
    """Open and shorted wires of a patch."""

    upper_open: Mask
    """(U,) mask of the open upper wires."""
    upper_short: Mask
    """(U,) mask of the shorted upper wires."""
    lower_open: Mask
    """(K,) mask of the open lower wires."""
    lower_short: Mask
    """(K,) mask of the shorted lower wires."""

    @staticmethod
    def none(profile: PatchProfile) -> WireFaults:
        """Return a fault-free WireFaults object."""
        return _no_faults((profile.rows, profile.columns))

    @property
    def masks(self) -> tuple[Mask, Mask, Mask, Mask]:
        """All masks: upper open, upper shorted, lower open, lower shorted."""
        return self.upper_open, self.upper_short, self.lower_open, self.lower_short

    @functools.cached_property
    def any(self) -> bool:
        """Whether at least one wire is open or shorted."""
        return any(mask.any() for mask in self.masks)


@functools.cache
def _no_faults(shape: tuple[int, int]) -> WireFaults:
    """Return a fault-free WireFaults object for U upper and K lower wires. Its arrays are read-only."""
    upper, lower = (np.zeros(wires, dtype=np.bool_) for wires in shape)
    for mask in (upper, lower):
        mask.flags.writeable = False
    return WireFaults(upper, upper, lower, lower)


def find_faults(codes: Codes, scale: CodeScale) -> WireFaults:
    """Return the wires whose crossings are all open or all shorted.

    Args:
        codes: (U, K) codes.
        scale: Mapping of R/R0 to codes.
    """
    if codes.max() < scale.short:  # the usual case
        return _no_faults((codes.shape[0], codes.shape[1]))
    is_open, is_short = codes == scale.open, codes == scale.short
    return WireFaults(is_open.all(axis=1), is_short.all(axis=1), is_open.all(axis=0), is_short.all(axis=0))


class WireFaultReporter:
    """Sends emergency messages when wire faults begin and end.

    Args:
        profile: Dimensions of the patch.
        emcy: EMCY producer of the node.
    """

    def __init__(self, profile: PatchProfile, emcy: EmcyProducer) -> None:
        self._profile, self._emcy = profile, emcy
        self._reported = WireFaults.none(profile)

    def reset(self) -> None:
        """Forget the reported faults after a reset, so that persistent faults are reported again."""
        self._reported = WireFaults.none(self._profile)

    def report(self, faults: WireFaults, t_ns: int) -> None:
        """Report new wire faults, or the end of all wire faults.

        Faults that begin in the same scan, for example when a connector is unplugged, are reported in one
        message that contains the type and wire number of the first new fault and the number of faulty wires.

        Args:
            faults: Current wire faults.
            t_ns: Current time, in ns.
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
