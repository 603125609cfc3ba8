"""Exact tracker for a live stream: solves each wire from its solution in the previous frame.

``tracker`` runs the stages of the solution; ``stream`` stores a stream's arrays and accepts roots.
``recover`` retries failed wires, and ``leave_out`` reduces the number of unknowns. ``contacts`` finds loads
and contacts in a solved field.
"""
