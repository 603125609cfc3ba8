"""Path following (Xu et al. 2018): solves a recorded press offline, sample by sample.

``path`` contains the entry point. ``step_control`` chooses the points to solve, and ``path_tracker`` moves
the wires along the path. ``predictor`` estimates the next positions, and ``corrector`` solves for them.
``root_selection`` accepts or rejects the roots at the last sample.
"""
