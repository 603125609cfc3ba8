"""Compiled solver for the upper wires of a patch; used by the exact tracker and the path tracker.

``problem`` derives the dimensionless equations of a patch, and ``arrays`` declares the arrays of the kernels.
``decode`` converts codes to resistances. ``solve_wires`` solves the wires one after another, using the
functions in ``hold``, ``follow`` and ``correct``. ``stages`` contains the computations before and after the
solve. ``patch_solver`` runs all of these in one compiled call. ``root_check`` finds roots that may be wrong.
"""
