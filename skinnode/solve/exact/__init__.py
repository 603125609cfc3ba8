"""The exact tracker of a live stream: each frame is solved from the frame before, wire by wire.

``tracker`` runs the stages, ``stream`` holds the arrays of a stream and decides which roots count,
``recover`` bridges wires that failed, ``leave_out`` solves for fewer unknowns.
"""
