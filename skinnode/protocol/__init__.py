"""Object dictionary and PDO contents of a patch, as pure code without a bus or clock.

Node:  resistances → ``codec`` → PDO payloads, mapped as ``profile`` defines.
Host:  PDO payloads → ``codec`` → ``assembler`` → one complete scan.
"""
