"""What a patch sends: its object dictionary and the content of its PDOs. Pure code, no bus, no clock.

Node:  resistances → ``codec`` → PDO payloads, mapped as ``profile`` says.
Host:  PDO payloads → ``codec`` → ``assembler`` → one complete scan.
"""
