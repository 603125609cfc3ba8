"""Compiled solver for the upper wires of a patch, shared by the exact tracker and path following.

``problem`` scales a patch to dimensionless systems, and ``arrays`` declares the arrays that kernels read and
write. ``decode`` converts the codes of a frame, ``solve_wires`` solves the wires one by one with ``hold``,
``follow`` and ``correct``, and ``stages`` does the remaining work on a frame. ``patch_solver`` combines all
these steps in one call. ``root_check`` finds roots that may be wrong.
"""
