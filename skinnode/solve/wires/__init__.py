"""One upper wire after the other, compiled: shared by the exact tracker and path following.

``problem`` scales a patch to dimensionless systems, ``arrays`` declares what kernels read and write,
``decode`` takes in a frame, ``solve_wires`` goes through the wires and tries ``hold``, ``follow`` and
``correct``; ``stages`` does the rest of the work on a frame, ``patch_solver`` makes all of it one call.
``root_check`` says which roots may be wrong.
"""
