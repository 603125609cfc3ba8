"""What the host knows of a patch once its node has been configured."""

from __future__ import annotations

from dataclasses import dataclass, replace

from skinnode.config import PatchConfig
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile


@dataclass(frozen=True, slots=True, eq=False)
class NodeFacts:
    """What bring-up learned about a patch."""

    config: PatchConfig
    layout: PatchLayout
    profile: PatchProfile
    scale: CodeScale
    baseline_ohm: Float
    """(U, K) resistances at rest, as the node encodes with them."""
    serial: int | None
    """None where nobody could ask."""
    heartbeat_s: float
    """How often the node sends one."""
    checked: bool = False
    """Whether the node is known to send a check with every scan; False if its revision could not be read."""

    def with_baseline(self, baseline_ohm: Float) -> NodeFacts:
        """The same patch after a tare."""
        return replace(self, baseline_ohm=baseline_ohm)
