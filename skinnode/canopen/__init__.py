"""Constants and pure functions for CiA 301, 305 and 306, shared by nodes, hosts and tools.

``indices``, ``nmt``, ``abort``, ``emergency``, ``sdo`` and ``lss`` define constants such as indices, commands
and error codes. ``dictionary`` and ``communication`` declare objects, and ``eds`` writes them as an EDS or
DCF file. The conformance suite does not use this package and thus remains an independent implementation of
the standards.
"""
