"""The patch itself, an application of a CANopen device.

``source`` measures resistances → ``acquisition`` makes codes → ``application`` takes scans at SYNC, by timer
or on command → ``scan_stream`` sends each scan as chunks and a summary. ``patch_node`` puts the device and
the application together.
"""
