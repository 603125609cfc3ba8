"""Patch application of a CANopen device.

``source`` measures resistances → ``acquisition`` converts them to codes → ``application`` takes scans at
SYNC, by timer or on command → ``scan_stream`` sends each scan as chunks and a summary. ``patch_node``
combines the device and the application.
"""
