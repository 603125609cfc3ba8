"""Process data objects.

``parameters`` guards and reads the records of a PDO, ``rpdo`` receives, ``tpdo`` transmits.
"""
