"""Dense linear algebra for kernels.

``vectors``, ``lu``, ``qr`` and ``bidiagonal`` are for the Jacobian of one wire. ``cholesky``, which includes
triangular solves and matrix products, is for the matrices of a whole patch.
"""
