"""Constants and pure functions for CiA 301, 305 and 306, shared by the node, the host and the tools.

The modules ``indices``, ``nmt``, ``abort``, ``emergency``, ``sdo`` and ``lss`` define the constants of these
standards, such as indices, commands and error codes. The modules ``dictionary`` and ``communication``
describe an object dictionary, and ``eds`` writes the object dictionary as an EDS or DCF file. The conformance
suite does not use this code, because it tests the node with an independent implementation of the standard.
"""
