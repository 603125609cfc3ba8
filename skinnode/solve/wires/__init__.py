"""One upper wire after the other, compiled: shared by the exact tracker and path following.

``problem`` scales a patch to dimensionless systems, ``driver`` solves them, ``follow`` holds a wire or
follows it with an earlier inverse, ``frame`` does the work before and after a solve, ``patch_solver`` makes
it one call.
"""
