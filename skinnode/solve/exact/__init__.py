"""Exact tracker for a live stream, which starts each solve at the wire's solution for the previous frame.

``tracker`` runs the stages of the solution. ``stream`` contains the arrays of a stream and decides whether a
root is accepted.
``recover`` retries failed wires, and ``leave_out`` reduces the number of unknowns. ``contacts`` finds loads
and contacts in a solved field.
"""
