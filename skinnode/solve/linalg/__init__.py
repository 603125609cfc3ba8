"""Dense linear algebra for kernels.

``vectors``, ``lu``, ``qr`` and ``bidiagonal`` process the Jacobian of one wire; ``cholesky``, with triangular
solves and products, processes a whole patch.
"""
