"""Finds readings that contradict the others, and decides whether a field is trusted.

``reading_model`` models the joint distribution of a layout's readings, linearised at rest. ``explanations``
finds the most likely explanation of a frame, either loads or wrong readings; the candidates come from
``greedy_search``, ``wire_tests`` and ``crossed_wires``. ``fault_list`` determines which readings are left out
of the next frames. ``trust`` decides whether a field and its wires are trusted. ``data_check`` runs these
checks on each field of a tracker.
"""
