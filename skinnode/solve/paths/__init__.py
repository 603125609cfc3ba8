"""Offline path following, the method of Xu et al. 2018: ``path`` solves a recorded press, ``path_tracker``
holds every wire's position along it, ``step_control`` chooses the points to solve.
"""
