"""SDO server of a node, for expedited, segmented and block transfers (CiA 301 v4.2, 7.2.4.3).

The module ``server`` performs expedited and segmented transfers, and ``block`` performs block transfers. The
module ``transfer`` contains the code shared by all types of transfer.
"""
