"""Process data objects.

``parameters`` reads the records of a PDO and checks writes to them, ``rpdo`` receives, ``tpdo`` transmits.
"""
