"""The exact tracker of a live stream: each frame is solved from the frame before, wire by wire.

``tracker`` runs the stages, ``patch_stream`` holds the arrays of a stream and decides which roots count,
``recovery`` bridges wires that failed, ``leaving_out`` solves for fewer unknowns.
"""
