"""Exact tracker for a live stream, which solves each wire of a frame from the previous frame.

``tracker`` runs the stages, ``stream`` stores the arrays of a stream and accepts roots, ``recover`` retries
wires that failed, and ``leave_out`` reduces the number of unknowns. ``contacts`` finds loads and
contacts in a solved field.
"""
