"""Object dictionary and PDO contents of a patch, as pure code that needs no bus or clock.

Node:  resistances → ``codes`` → codes → ``chunk``, ``summary`` → PDO payloads, mapped as ``profile`` defines.
Host:  PDO payloads → ``chunk``, ``summary`` → ``assembler`` → one complete scan → ``codes`` → resistances.

``codec`` only re-exports the public names of these modules.
"""
