"""Define the parameters of a patch that are known after its node has been configured."""

from __future__ import annotations

from dataclasses import dataclass, replace

from skinnode.config import PatchConfig
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile


@dataclass(frozen=True, slots=True, eq=False)
class NodeFacts:
    """Parameters of a patch, collected during the configuration of its node."""

    config: PatchConfig
    layout: PatchLayout
    profile: PatchProfile
    scale: CodeScale
    baseline_ohm: Float
    """(U, K) ohm: resistances at rest, to which the codes in the node's scans are relative."""
    serial: int | None
    """Serial number of the node; None if the host is not allowed to read the serial number."""
    heartbeat_s: float
    """Heartbeat period of the node, s."""
    checked: bool = False
    """Whether the node sends a check over all codes with every scan; False if the node's revision number
    could not be read.
    """

    def with_baseline(self, baseline_ohm: Float) -> NodeFacts:
        """Return a copy with a different baseline, for example after a tare."""
        return replace(self, baseline_ohm=baseline_ohm)
