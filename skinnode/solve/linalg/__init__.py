"""Dense linear algebra for kernels.

``vectors``, ``lu``, ``qr`` and ``bidiagonal`` process the Jacobian of one wire. ``cholesky``, which includes
triangular solves and matrix products, processes the matrices of a whole patch.
"""
