"""Process data objects (PDO) of a node: their parameters, the RPDO engine and the TPDO engine."""
