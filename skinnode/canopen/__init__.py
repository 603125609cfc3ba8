"""Constants and pure functions for CiA 301, 305 and 306, shared by node, host and tools.

``indices``, ``nmt``, ``abort``, ``emergency``, ``sdo`` and ``lss`` define each number once. ``dictionary``
and ``communication`` describe an object dictionary, which ``eds`` writes as an EDS or DCF file. The
conformance suite deliberately uses none of this code, so that it checks the node against an independent
reading of the standard.
"""
