"""Dense linear algebra for kernels.

``vectors``, ``lu``, ``qr`` and ``bidiagonal`` are for the Jacobian of one wire; ``cholesky``, with triangular
solves and products, is for a whole patch.
"""
