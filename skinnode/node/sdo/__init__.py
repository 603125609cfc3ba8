"""Service data objects: ``server`` answers requests and runs segmented transfers, ``block`` block transfers.

``transfer`` holds what all transfers share: channel, time-out, and the value that a download collects.
"""
