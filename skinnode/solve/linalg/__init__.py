"""Dense linear algebra for kernels: ``factorisations`` (LU, QR, bidiagonal) of one wire's Jacobian,
``cholesky`` and products of a whole patch.
"""
