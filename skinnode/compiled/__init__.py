"""Infrastructure for compiled kernels.

``jit`` provides the decorators, ``kernel_cache`` stores compiled kernels, ``array_table`` passes many arrays
in one argument, and ``simd`` provides vector instructions.
"""
