"""Tests of the readings for contradictions, and the decision whether to trust a field.

``data_check`` checks each field of a tracker. It uses ``reading_model``, the joint distribution of a layout's
readings linearised at rest. ``explanations`` finds the most likely explanation of a frame: either loads or
wrong readings. Its candidates come from ``greedy_search``, ``wire_tests`` and ``crossed_wires``.
``fault_list`` decides which readings to leave out of the next frames. ``trust`` decides whether a field and
each of its wires are trusted.
"""
