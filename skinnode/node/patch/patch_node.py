"""CANopen node of a patch: a :mod:`skinnode.node.device` that runs the patch application."""

from __future__ import annotations

from collections.abc import Callable

from skinnode.model.layout import Float, PatchLayout
from skinnode.node.application import ApplicationServices
from skinnode.node.device import CanopenDevice
from skinnode.node.memory import Memory
from skinnode.node.pacing import THRIFTY, Pacing
from skinnode.node.patch.acquisition import Acquisition
from skinnode.node.patch.application import PatchApplication
from skinnode.node.patch.source import ResistanceSource
from skinnode.node.rejected import Rejected
from skinnode.node.services import Send
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.eds_files import eds_name
from skinnode.protocol.profile import PatchProfile


class PatchNode(CanopenDevice):
    """CANopen node of one patch. It is silent until :meth:`power_on` is called.

    Args:
        node_id: 1 to 127, or 255 to wait until LSS assigns a node-ID. A node-ID that LSS has stored in the
            memory takes precedence.
        layout: Electrodes of the patch, which determine the dimensions in the object dictionary.
        source: Analogue front end of the patch.
        send: Function that sends a frame, given its COB-ID and payload.
        profile: Wire format of the patch; by default, 16-bit codes on classic CAN.
        serial: Serial number (0x1018:4 and 0x2000:11), u32.
        baseline_ohm: (U, K) initial R0 in ohms; None to tare at the first power-on. A baseline in the memory
            takes precedence.
        pacing: :data:`~skinnode.node.pacing.EXACT` for a node on its own board,
            :data:`~skinnode.node.pacing.THRIFTY` for many nodes on one computer.
        memory: Non-volatile memory for the parameters, baseline and LSS configuration, or None.
        set_bit_rate: Function that changes the bit rate (bit/s), or None if LSS cannot change it.

    Raises:
        ValueError: If an argument is out of range.
        ConfigError: If the wire format cannot represent the layout.
    """

    def __init__(  # noqa: PLR0913 - public keywords, one for each part that a board brings
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

        def application(services: ApplicationServices) -> PatchApplication:
            self._patch = PatchApplication(layout, serial, acquisition, services, pacing)
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
        """Number of scans sent since the node was created."""
        return self._patch.stream.scans_sent

    @property
    def baseline_ohm(self) -> Float:
        """(U, K) baseline R0 in ohms; 0 where unknown."""
        return self._patch.baseline_ohm

    @property
    def source_failures(self) -> int:
        """Number of scans, tares and self-test readings for which the source returned no valid reading."""
        return self._patch.source.failures

    @property
    def source_error(self) -> str:
        """One-line description of the latest source failure; empty if there has been none."""
        return self._patch.source.error

    @property
    def rival_frames(self) -> int:
        """Number of boot-ups and heartbeats received from another node with the same node-ID."""
        return self._rejected.counted(Rejected.OWN_ERROR_CONTROL)

    @property
    def memory_problem(self) -> str:
        """One-line description of the latest memory problem; empty if there has been none."""
        return self._storage.problem

    @property
    def overruns(self) -> int:
        """Number of scans skipped because one scan was still being sent and another was waiting."""
        return self._patch.overruns

    @property
    def slow_overruns(self) -> int:
        """Number of scans skipped because the computer or the bus was too slow."""
        return self._patch.slow_overruns
