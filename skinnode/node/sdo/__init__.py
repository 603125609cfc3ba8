"""Service data objects (SDO): ``server`` runs expedited and segmented transfers, ``block`` block transfers.

``transfer`` holds the parts shared by all transfers: channel, time-out, and the value of a download.
"""
