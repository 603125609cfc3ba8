"""Object dictionary and PDO payloads of a patch, as pure functions without bus or clock access.

A node uses ``codes`` to convert resistances to codes, and ``chunk`` and ``summary`` to pack these codes into
PDO payloads. A host uses ``chunk`` and ``summary`` to unpack the payloads, ``assembler`` to collect them into
scans, and ``codes`` to convert the codes back to resistances. The module ``profile`` contains the sizes of
the patch.

The module ``codec`` only re-exports the public names of these modules.
"""
