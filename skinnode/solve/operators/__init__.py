"""The operators Gauss-Newton, Levenberg-Marquardt and dogleg (one file each), and their workspace ``work``.

``trust_region`` decides whether to accept a step, and ``loop`` iterates the operator selected by its number
in ``codes``. ``system`` contains ``solve_system``, which solves any system with at least as many equations as
unknowns, in one or more attempts (``attempt``). ``minimum`` tests and refines minima with a non-zero
residual, and ``result`` defines the returned object.
"""
