"""Patch application of a CANopen device.

``application`` takes a scan on a SYNC, on a timer or on command. ``acquisition`` reads the source and encodes
the resistances, ``chunk_selection`` selects the chunks to send, and ``scan_stream`` sends the chunks and the
summary.

``patch_node`` combines the application with a device, and ``objects`` connects it to the object dictionary.
``wire_faults``, ``source_monitor`` and ``self_test`` detect faults in the patch. ``find_source`` creates the
source named on the command line.
"""
