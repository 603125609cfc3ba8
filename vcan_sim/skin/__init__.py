"""Imperfect patches: how a patch and its read-out deviate from the layout file.

::

    imperfections (sizes and seed) -> body (actual electrode positions)
    scene -> hysteresis_and_creep (displacement of the rubber) -> forward (conductance of each path)
        -> crossbar (resistances between wires, as read out) -> front_end (amplifier, converter)

The ``patch`` module combines these steps for one patch. The package shares no code with the solvers. If all
sizes are zero, the patch is exact: it has point electrodes at the positions in the layout file, and a reading
is the resistance of an isolated pair of wires.
"""
