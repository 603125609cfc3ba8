"""Resistances to displacement. No bus, no threads.

``tracker`` answers a live stream by the method that suits the patch: ``exact`` inverts wire by wire,
``posterior`` estimates the whole patch. ``root_gate`` puts the doubtful wires of the first to the second, by
the rules and thresholds of ``roots``. ``paths`` follows a recorded press. All three use ``operators``,
``linalg`` and ``wires``.
"""
