"""Offline path following, after Xu et al. 2018: solves the last sample of a press via the earlier samples.

The entry point is ``path``, which solves a recorded press. ``step_control`` chooses the points to solve,
``path_tracker`` stores the position of every wire, and ``predictor`` and ``corrector`` move the wires.
``root_selection`` decides at the end which roots to accept.
"""
