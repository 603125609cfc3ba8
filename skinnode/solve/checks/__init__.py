"""Tests of the data behind a field: which readings contradict the others, and whether the field is trusted.

``reading_model`` describes, for one layout, how readings at rest vary together; ``explanations`` finds the
likeliest explanation of a frame: loads, or readings that are wrong (with ``greedy_search``, ``wire_tests``
and ``crossed_wires``); ``fault_list`` decides from frame to frame which readings are named and left out;
``trust`` states what may be believed; ``data_check`` runs them on each field of a tracker.
"""
