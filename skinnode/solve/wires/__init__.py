"""Compiled solver for the upper wires of a patch, shared by the exact tracker and path following.

``problem`` converts a patch to dimensionless systems of equations, and ``arrays`` declares the arrays that
kernels read and write. ``decode`` converts a frame's codes to resistances. ``solve_wires`` solves the wires
one by one, using ``hold``, ``follow`` and ``correct``; ``stages`` contains the steps before and after the
solve. ``patch_solver`` combines all these steps in one call. ``root_check`` finds roots that may be wrong.
"""
