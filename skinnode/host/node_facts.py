"""Define what the host knows about a patch once its node has been configured."""

from __future__ import annotations

from dataclasses import dataclass, replace

from skinnode.config import PatchConfig
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile


@dataclass(frozen=True, slots=True, eq=False)
class NodeFacts:
    """Facts about a patch, collected while its node is configured."""

    config: PatchConfig
    layout: PatchLayout
    profile: PatchProfile
    scale: CodeScale
    baseline_ohm: Float
    """(U, K) resistances at rest, in ohms. The scans' codes are relative to these."""
    serial: int | None
    """Serial number of the node; None if the host must not read it."""
    heartbeat_s: float
    """Heartbeat period of the node, in seconds."""
    checked: bool = False
    """Whether each scan's summary contains a check value for all codes; False if the node's revision number
    is unknown.
    """

    def with_baseline(self, baseline_ohm: Float) -> NodeFacts:
        """Return a copy with a different baseline."""
        return replace(self, baseline_ohm=baseline_ohm)
