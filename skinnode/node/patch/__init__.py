"""Patch application of a CANopen device.

::

    source -> acquisition (resistances to codes) -> application (a scan at SYNC, by timer or on command)
        -> chunk_selection (which chunks to send) -> scan_stream (chunks and summary, one after the other)

``patch_node`` combines the device and the application. ``objects`` binds these parts to the object
dictionary. ``wire_faults``, ``source_monitor`` and ``self_test`` detect faults of the patch and report them
as EMCY messages, flags and objects. ``find_source`` loads the source named on the command line.
"""
