"""The host: discover, configure, start, supervise; receive, assemble, solve, publish."""

from skinnode.host.facade import Host, HostStats
from skinnode.host.hand_frame import HandFrame
from skinnode.host.health import Condition, PatchHealth
from skinnode.host.publish import Subscription
from skinnode.host.start import BringUpCancelled

__all__ = ["BringUpCancelled", "Condition", "HandFrame", "Host", "HostStats", "PatchHealth", "Subscription"]
