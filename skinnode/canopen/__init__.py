"""CiA 301, 305 and 306 as data and pure functions, shared by node, host and tools: one place for each number.

``indices``, ``nmt``, ``abort``, ``emergency``, ``sdo`` and ``lss`` hold the constants; ``dictionary`` and
``communication`` describe an object dictionary, which ``eds`` writes as an EDS or DCF file. The conformance
suite shares none of it on purpose: it checks the node against its own reading of the standard.
"""
