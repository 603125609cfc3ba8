"""A patch as a CANopen device: the device of :mod:`skinnode.node.device` with the application of
:mod:`skinnode.node.patch.application`."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.model.layout import Float, PatchLayout
from skinnode.node.clock import THRIFTY, Pacing
from skinnode.node.device import CanopenDevice, Send, Services
from skinnode.node.memory import Memory
from skinnode.node.patch.acquisition import Acquisition
from skinnode.node.patch.application import PatchApplication
from skinnode.node.patch.source import ResistanceSource
from skinnode.node.rejected import Rejected
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.eds_files import eds_name
from skinnode.protocol.profile import PatchProfile


class PatchNode(CanopenDevice):
    """One patch.

    Args:
        node_id: 1 to 127, or 255 for none: LSS gives it one. What LSS has stored in the memory counts
            instead.
        layout: its electrodes; decides the sizes of the object dictionary.
        source: its analogue port, read once per scan.
        send: called with COB-ID and payload of every frame the node sends, in order.
        profile: its wire format. Default: that of the layout, with codes of 16 bits.
        serial: serial number (0x1018:4 and 0x2000:11), u32.
        baseline_ohm: (U, K) R0 to begin with, ohm; None to tare at the first power-on. The baseline in the
            memory counts instead.
        pacing: :data:`~skinnode.node.clock.EXACT` for a board, THRIFTY where many nodes share a machine.
        memory: keeps configuration, baseline and node-ID over a power cycle; None: a power cycle loses what
            was written, and the node says so.
        set_bit_rate: changes the bit rate (bit/s) for LSS; None where that is not the node's own to do.

    Raises ValueError or ConfigError for an argument out of range. The node is silent until :meth:`power_on`.
    """

    def __init__(
        self,
        node_id: int,
        layout: PatchLayout,
        source: ResistanceSource,
        *,
        send: Send,
        profile: PatchProfile | None = None,
        serial: int = 0,
        baseline_ohm: Float | None = None,
        pacing: Pacing = THRIFTY,
        memory: Memory | None = None,
        set_bit_rate: Callable[[int], None] | None = None,
    ) -> None:
        self.profile = PatchProfile.from_layout(layout) if profile is None else profile
        acquisition = Acquisition(self.profile, source, CodeScale(self.profile.code_bits), baseline_ohm)
        self.pacing = pacing
        self._patch: PatchApplication

        def application(services: Services) -> PatchApplication:
            self._patch = PatchApplication(layout, self.profile, serial, acquisition, services, pacing)
            return self._patch

        super().__init__(
            node_id,
            self.profile.objects(),
            application,
            send=send,
            serial=serial,
            memory=memory,
            kind=f"{eds_name(self.profile).removesuffix('.eds')} layout {layout.layout_hash:08x}",
            set_bit_rate=set_bit_rate,
        )

    @property
    def scans_sent(self) -> int:
        """Scans sent to their end since the node was made."""
        return self._patch.stream.scans_sent

    @property
    def source_failures(self) -> int:
        """Readings that the source failed to give."""
        return self._patch.source_failures

    @property
    def source_error(self) -> str:
        """What the source failed of last, in one line; empty if it never did."""
        return self._patch.source_error

    @property
    def rival_frames(self) -> int:
        """Boot-up messages and heartbeats of another node with this node-ID."""
        return self._rejected.counted(Rejected.OWN_ERROR_CONTROL)

    @property
    def memory_problem(self) -> str:
        """What went wrong with the memory last, in one line; empty if nothing did."""
        return self._storage.problem

    @property
    def overruns(self) -> int:
        """Scans skipped because two others were still to be sent."""
        return self._patch.overruns

    @property
    def slow_overruns(self) -> int:
        """Number of overruns because this computer, or the bus, was too slow."""
        return self._patch.slow_overruns
