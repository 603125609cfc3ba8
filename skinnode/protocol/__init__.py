"""Object dictionary and PDO payloads of a patch, as pure functions without bus or clock access.

Node:  resistances → ``codes`` → codes → ``chunk``, ``summary`` → PDO payloads, mapped as ``profile`` defines.
Host:  PDO payloads → ``chunk``, ``summary`` → ``assembler`` → one complete scan → ``codes`` → resistances.

The module ``codec`` only re-exports the public names of these modules.
"""
