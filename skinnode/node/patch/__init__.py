"""Patch application of a CANopen device.

The module ``application`` takes a scan at each SYNC, by timer or on command. ``acquisition`` reads the
resistances from the source and encodes them as codes, ``chunk_selection`` selects the chunks to send, and
``scan_stream`` sends the chunks and the summary.

The module ``patch_node`` combines the device and the application. The module ``objects`` connects the
application to the object dictionary. The modules ``wire_faults``, ``source_monitor`` and ``self_test`` detect
faults of the patch. The node reports patch faults in emergency messages, summary flags and objects. The
module ``find_source`` loads the source given on the command line.
"""
