"""Compiled code other than the kernels themselves.

``jit`` decorates kernels, ``kernel_cache`` stores them, ``array_table`` passes many arrays in one argument,
``simd`` holds vector instructions.
"""
