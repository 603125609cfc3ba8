"""Dense linear algebra for kernels: ``vectors``, ``lu``, ``qr`` and ``bidiagonal`` for the Jacobian of one
wire; ``cholesky``, with triangular solves and products, for a whole patch.
"""
