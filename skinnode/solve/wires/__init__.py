"""Compiled solver for the upper wires of a patch; used by the exact tracker and the path tracker.

The module ``problem`` derives dimensionless equations from a patch, and ``arrays`` declares the arrays that
the kernels read and write. ``decode`` converts codes to resistances. ``solve_wires`` solves one wire after
another with the functions in ``hold``, ``follow`` and ``correct``. ``stages`` contains the computations
before and after the solve. ``patch_solver`` performs all of these computations in one compiled call.
``root_check`` finds roots that may be wrong.
"""
