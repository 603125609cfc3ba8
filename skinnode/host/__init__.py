"""The host: configure, start and supervise nodes; receive, assemble, solve and publish their scans.

**Data flow.** ``host`` owns all parts; ``lifecycle`` starts and stops them. Each bus has a ``link`` (port,
receive thread, reopening) and a ``served_bus``; each patch has a ``patch_stream`` and a ``node_monitor``::

    link (receive thread) -> drop_oldest_queue -> mainline -> dispatcher (frame to its handler, set up in
        reception) -> patch_stream (scan assembly; accounting of losses) -> code_watch (which data to use)
        -> workers, scan_solver -> publish (subscriptions), callback, hand_frame, trust_report
    code_watch  =  code_runs -> converter_liveness (is the patch frozen?), frozen_parts (is a wire or crossing
        frozen?), wire_windows and wire_faults (noisy, drifting, open, shorted wires)

    start (bring-up of all nodes) -> configurator (one node: write, verify, store), node_facts, lss_master
    supervisor -> node_supervision -> supervised (what is due for a node) -> remote_node, sdo_client (by SDO)
    node_monitor (evidence about a node) -> health (condition) -> health_watch -> events

Producers: ``sync`` (SYNC), ``nmt_master`` (NMT commands). ``containment`` catches exceptions; ``retry_pause``
spaces repeated attempts; ``tap`` hands frames and fields to recorders.

**Containment.** Exceptions do not end the host's threads. An exception raised while serving a patch makes
that patch faulty and is recorded as the reason: the scans of the patch are withheld, and the patch is brought
up again after a pause of 0.1 s, which doubles with each defect, up to 1 s; a boot-up of the node ends the
pause. An exception raised while serving a bus pauses the bus, or causes its interface to be closed and
reopened, with pauses of the same length. If an exception is raised while serving a subscriber, a callback or
a tap, only the item meant for that recipient is lost. All exceptions are counted by subject
(``Host.stats().defects``), published as events, and logged once for each distinct message; see
:mod:`skinnode.host.containment`.

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
rejoin      search by LSS                   that search                     after a second
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

from skinnode.host.hand_frame import HandFrame
from skinnode.host.health import Condition, PatchHealth
from skinnode.host.host import Host, HostStats
from skinnode.host.publish import Subscription
from skinnode.host.start import BringUpCancelled

__all__ = ["BringUpCancelled", "Condition", "HandFrame", "Host", "HostStats", "PatchHealth", "Subscription"]
