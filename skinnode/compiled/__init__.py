"""Support for kernels compiled with numba.

``jit`` contains the decorators, ``kernel_cache`` the cache of compiled kernels, ``array_table`` a type that
passes many arrays to a kernel in one argument, and ``simd`` vector instructions.
"""
