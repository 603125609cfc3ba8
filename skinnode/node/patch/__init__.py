"""Patch application of a CANopen device.

::

    source -> acquisition (resistances to codes) -> application (a scan at SYNC, by timer or on command)
        -> chunk_selection (which chunks to send) -> scan_stream (chunks and summary, one after the other)

The module ``patch_node`` combines the device and the application. The module ``objects`` connects the
application to the object dictionary. The modules ``wire_faults``, ``source_monitor`` and ``self_test`` detect
faults of the patch. The node reports patch faults in emergency messages, summary flags and objects. The
module ``find_source`` loads the source given on the command line.
"""
