"""Simulation of imperfect patches: deviations of a patch and its read-out from the layout file.

::

    imperfections (sizes and seed) -> body (actual electrode positions)
    scene -> history (hysteresis and creep of the rubber) -> forward (conductance of each path)
        -> crossbar (resistances between wires, as read out) -> front_end (amplifier, converter)

The module ``patch`` performs these calculations for one patch at a given time. This package shares no code
with the solvers. If all sizes are zero, the patch is exact: it has point electrodes at the positions in the
layout file, and each reading is the resistance of an isolated pair of wires.
"""
