"""Gauss-Newton, Levenberg-Marquardt and dogleg, a file each: the step of each from the same ``work`` space.

``trust_region`` decides whether a step is taken, ``loop`` goes from step to step and knows no method but by
its number in ``codes``. ``system`` solves any square or tall system, ``result`` is what that returns.
"""
