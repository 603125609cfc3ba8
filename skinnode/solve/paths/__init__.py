"""Offline path following (Xu et al. 2018): solves a press's last sample by way of the earlier samples.

The entry point is ``path``, which solves a recorded press. ``step_control`` chooses the points to solve,
``path_tracker`` stores the position of every wire, and ``predictor`` and ``corrector`` move the wires.
``root_selection`` decides which roots at the path's end to accept.
"""
