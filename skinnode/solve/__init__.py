"""Solvers that compute displacements from resistances, without buses or threads.

``tracker`` solves a live stream with the method that suits the patch: ``exact`` inverts each wire separately,
and ``posterior`` estimates the whole patch. ``root_gate`` checks doubtful wires of the exact inverse with the
posterior, using the rules and thresholds in ``roots``. ``checks`` finds readings that contradict the others
and determines whether a field is trusted. ``noise_estimate`` corrects a stated noise that the stream
contradicts; ``precision`` compares standard deviations with the limits that the user set. ``paths`` follows a
recorded press. All these modules use ``operators``, ``linalg`` and ``wires``.
"""
