"""Object dictionary and PDO payloads of a patch. Nothing in this package accesses a bus or a clock.

A node encodes resistances (``codes``) and packs the codes into PDOs (``chunk``, ``summary``). A host
assembles the PDOs into scans (``assembler``) and decodes the codes. ``profile`` defines the dimensions of a
patch, which determine the wire format. ``codec`` re-exports the public names of the other modules.

``c_kit`` generates a C99 implementation for board firmware and other masters. Its source code is
in the folder ``c``.
"""
