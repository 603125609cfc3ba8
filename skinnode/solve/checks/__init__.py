"""Check frames for contradictory readings and decide which fields to trust.

``data_check`` checks each field of a tracker. The checks use ``reading_model``, the joint distribution of a
layout's readings linearised at rest, and ``linearised_readings``, the readings of one frame. ``last_field``
is the field with which the next field is compared. ``examination_time`` decides whether there is time to
examine a suspicious frame. ``explanations`` finds the most likely explanation of a frame: either loads or
wrong readings. ``greedy_search``, ``wire_tests`` and ``crossed_wires`` supply the candidates. ``fault_list``
decides which readings to leave out of the next frames. ``field_trust`` decides whether a field and each of
its wires are trusted.
"""
