"""Resistances to displacement. No bus, no threads.

``tracker`` answers a live stream by the method that suits the patch: ``exact`` inverts wire by wire,
``posterior`` estimates the whole patch. ``paths`` follows a recorded press. All three use ``operators``,
``linalg`` and ``wires``.
"""
