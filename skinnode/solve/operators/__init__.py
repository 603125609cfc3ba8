"""Operators that compute the steps of a solve: Gauss-Newton, Levenberg-Marquardt and dogleg.

Each operator has its own module; they share the workspace in ``work``. ``trust_region`` accepts or rejects a
step, and ``loop`` iterates one of the operators, selected by its number in ``codes``. ``system`` contains
``solve_system``, which solves any system with at least as many equations as unknowns, in one or more attempts
(``attempt``). ``minimum`` tests and refines minima with a non-zero residual. ``result`` defines the result of
``solve_system``.
"""
