"""Offline path following (Xu et al. 2018): solves a recorded press sample by sample, up to the last sample.

The entry point is ``path``, which solves a recorded press. ``step_control`` chooses the points to solve,
and ``path_tracker`` stores the position of every wire. ``predictor`` estimates the next positions, and
``corrector`` solves for them. ``root_selection`` accepts or rejects the roots found at the last sample.
"""
