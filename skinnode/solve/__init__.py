"""Solvers that compute displacements from resistances; independent of buses and threads.

``tracker`` solves a live stream with one of two methods: ``exact`` inverts each wire separately, and
``posterior`` estimates the whole patch. ``detect`` decides, before a frame is solved, whether the patch is
touched. ``root_gate`` checks doubtful roots of the exact inverse with the posterior; ``roots`` contains the
criteria. ``checks`` finds readings that contradict the others, and decides
whether a field is trusted. ``noise_estimate`` corrects the stated noise if the stream contradicts it.
``skew`` converts the field of a moving skin to a single instant if its wires are sampled one after the other.
``precision`` compares standard deviations with the user's limits. ``paths`` follows the displacements through
a recorded press. All of these use ``operators``, ``linalg`` and ``wires``.
"""
