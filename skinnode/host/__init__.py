"""The host: discover, configure, start, supervise; receive, assemble, solve, publish."""

from skinnode.host.facade import Host, HostStats
from skinnode.host.health import Condition, PatchHealth
from skinnode.host.publish import Subscription
from skinnode.host.start import BringUpCancelled

__all__ = ["BringUpCancelled", "Condition", "Host", "HostStats", "PatchHealth", "Subscription"]
