"""Gauss-Newton, Levenberg-Marquardt and dogleg: ``steps`` holds the compiled steps, ``system`` solves any
square or tall system with them, ``result`` is what that returns.
"""
