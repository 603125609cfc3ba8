"""Solvers that compute displacements from resistances, without buses or threads.

``tracker`` solves a live stream with the method that suits the patch: ``exact`` inverts each wire separately,
and ``posterior`` estimates the whole patch. ``root_gate`` uses the posterior to check doubtful wires of the
exact inverse, according to the rules and thresholds in ``roots``. ``checks`` finds readings that contradict
other readings, and determines whether a field is trusted. ``noise_estimate`` corrects the configured noise if
the stream contradicts this value; ``precision`` compares standard deviations with the user's limits.
``paths`` tracks the displacements through a recorded press. All of these packages and modules use
``operators``, ``linalg`` and ``wires``.
"""
