"""Object dictionary and PDO payloads of a patch. Nothing in this package accesses a bus or a clock.

A node encodes resistances (``codes``) and packs the codes into PDOs (``chunk``, ``summary``). A host
assembles the PDOs into scans (``assembler``) and decodes the codes. ``profile`` defines the sizes of a patch,
on which the wire format depends. ``codec`` re-exports the public names of the other modules.
"""
