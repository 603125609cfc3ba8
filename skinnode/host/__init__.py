"""Configure, start and supervise nodes; receive, assemble, solve and publish their scans.

**Data flow.** The module ``lifecycle`` starts and stops the parts of a host; ``host`` is their public
interface, most of which it shares with remote hands (``running_hand``). Each bus has a ``link`` (port,
receive queue, reopening) and a ``served_bus``. Each patch has a ``patch_stream`` and a ``node_monitor``::

    receive thread -> link (receive queue) -> mainline -> dispatcher (calls the handlers set up in reception)
        -> patch_stream (assembles scans) -> code_watch (selects usable codes) -> workers, scan_solver
        -> publish (subscriptions, drop_oldest_queue) -> callback, hand_frame
    code_watch: repeated_codes -> converter_liveness (frozen patches), frozen_parts (frozen wires and
        crossings), noisy_and_drifting_wires, open_and_shorted_wires

    start (brings up all nodes) -> remote_node -> configurator (configures one node), sdo_client, lss_master
    supervisor -> node_supervision (actions for each supervised node) -> remote_node, baseline_watch
    node_monitor (evidence about a node) -> health (condition) -> health_watch -> events
    publish -> touch_changes (onsets and releases) -> health_watch -> events

Other modules send SYNC (``sync``) and NMT commands (``nmt_master``), contain exceptions (``containment``),
set the pauses between retries (``retry_pause``) and pass frames to recorders (``tap``).

**Containment.** An exception never ends a thread of the host. Its effect depends on where it occurs:

- A patch: the patch is marked faulty, with the exception as the reason, and its scans are withheld. After a
  pause, the patch is brought up again. The pause starts at 0.1 s and doubles with each exception, up to 1 s.
  A boot-up message from the node ends the pause early.
- A bus: the host stops serving the bus for 0.1 s to 1 s, or reopens its interface.
- A subscriber, a callback or a tap: only the item for this recipient is lost.

Exceptions are counted by subject (``Host.stats().defects``) and published as events. Each distinct message is
logged once (:mod:`skinnode.host.containment`).

==========  ==============================  ==============================  ==============================
thread      calls                           an exception there affects      recovers
==========  ==============================  ==============================  ==============================
receive     the port                        the bus: it is unavailable      interface reopened
receive     anything else                   one poll of the interface       20 ms later
mainline    handlers, pollers, jobs of a    the frame or call; the patch    patch brought up again
            patch                           is faulty
mainline    other handlers, listeners       the frame or batch, for them    with the next
mainline    its queue, counting, the load   the bus: it pauses, or its      after the pause
                                            statistics are incomplete
reopen      the port, a new receive thread  that attempt                    after the pause
sync        a bus                           one SYNC of that bus            with the next SYNC
solve       decoding, solving               the scan; the patch is faulty   patch brought up again
solve       a subscriber's queue            that subscriber's field         with the next field
supervisor  the state of a patch            the patch is faulty             patch brought up again
supervisor  the master's heartbeat          one heartbeat on that bus       with the next
rejoin      SDO                             that transfer                   tried three times
rejoin      bring-up, baseline, register    the patch is faulty             patch brought up again
search      search by LSS                   that search                     after a second
bring-up    a node, at the start            that attempt                    tried three times
health      patches, buses, defects         one check of them               50 ms later; events may repeat
health      a subscriber of events          that subscriber's event         with the next
callback    the program's function          that field, of that callback    with the next field
record      the disk                        the recording                   never; the host continues
record      anything else                   that entry                      with the next
any         a tap                           that entry, of that tap         with the next
the user's  subscriptions, hand frames      that iteration                  when iterated again
==========  ==============================  ==============================  ==============================
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skinnode.host.hand_frame import HandFrame
    from skinnode.host.health import Condition, PatchHealth
    from skinnode.host.host import Host, HostStats
    from skinnode.host.publish import Subscription
    from skinnode.host.running_hand import RunningHand
    from skinnode.host.start import BringUpCancelled

_HOME = {
    "BringUpCancelled": "skinnode.host.start",
    "Condition": "skinnode.host.health",
    "HandFrame": "skinnode.host.hand_frame",
    "Host": "skinnode.host.host",
    "HostStats": "skinnode.host.host",
    "PatchHealth": "skinnode.host.health",
    "RunningHand": "skinnode.host.running_hand",
    "Subscription": "skinnode.host.publish",
}

__all__ = [
    "BringUpCancelled",
    "Condition",
    "HandFrame",
    "Host",
    "HostStats",
    "PatchHealth",
    "RunningHand",
    "Subscription",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use, because many commands use parts of the host but not the solver."""
    if name not in _HOME:
        raise AttributeError(f"module 'skinnode.host' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value
