"""Process data objects (PDO) of a node.

The module ``parameters`` reads the records of a PDO and checks writes to these records. The module ``rpdo``
receives PDOs, and ``tpdo`` transmits PDOs.
"""
