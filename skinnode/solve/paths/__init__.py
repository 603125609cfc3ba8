"""Offline path following, the method of Xu et al. 2018: the samples of a press lead to the root of the last.

``path`` is the entry: it solves a recorded press. ``step_control`` chooses the points to solve,
``path_tracker`` holds every wire's position, ``predictor`` and ``corrector`` move it. ``root_selection``
decides at the end which roots are believed.
"""
