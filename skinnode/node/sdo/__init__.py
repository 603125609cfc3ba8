"""SDO server of a node, for expedited, segmented and block transfers (CiA 301 v4.2, 7.2.4.3).

``server`` implements expedited and segmented transfers; ``block`` implements block transfers.
``transfer`` contains the classes that they share.
"""
