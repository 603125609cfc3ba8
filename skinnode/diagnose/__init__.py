"""What a technician asks of a bus: who is there, how each node is, its object dictionary, NMT, LSS.

Plain functions over an open :class:`~skinnode.diagnose.bus_connection.BusConnection`; the commands of
:mod:`skinnode.cli` print what they return. Nothing here writes to a node unless its name says so.
"""
