"""Everything about compiled code that is not a kernel itself: ``jit`` decorates kernels, ``kernel_cache``
stores them, ``array_table`` passes many arrays in one argument, ``simd`` holds vector instructions.
"""
