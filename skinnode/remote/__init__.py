"""Publish the fields, health and events of a running host over Zenoh, for use in other processes.

**Data flow**::

    daemon    host -> publication (thread) -> outputs (one Zenoh publisher per topic) -> session
              session -> command_server -> host
    program   session -> inbox (bounded queue) -> receiver (thread) -> accounts, subscriptions of remote_hand
              remote_hand -> commands -> session

``session`` opens a Zenoh session, ``keys`` names topics and liveliness tokens as rmw_zenoh does, and
``attachment`` encodes the sequence number of a message as rmw_zenoh does. ``claim`` ensures that each hand
has only one daemon. ``description`` describes the hand to programs, and ``discovery`` finds published hands.
``accounts`` counts received and lost fields. ``connect`` connects a program to a hand.

**Rules.** The host never waits: it offers fields to a bounded queue. The daemon never waits for a program:
Zenoh drops messages for a connection whose queue is full. A program never delays its connection: its queue
drops the oldest message. Each dropped field appears as a gap in its patch's sequence numbers. A program
passes on data only from the daemon run whose description it has received. A command that the program has
abandoned is not executed.

This package requires the extra ``zenoh``.
"""

from skinnode.remote.connect import connect
from skinnode.remote.publication import Publication, publish
from skinnode.remote.remote_hand import RemoteHand
from skinnode.remote.session import SessionOptions

__all__ = ["Publication", "RemoteHand", "SessionOptions", "connect", "publish"]
