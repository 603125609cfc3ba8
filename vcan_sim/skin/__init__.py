"""Simulated skin as manufactured and read out: deviations of a patch from its layout file.

::

    imperfections (sizes and seed) -> body (actual electrode positions)
    scene -> history (hysteresis and creep of the rubber) -> forward (conductance of each path)
        -> crossbar (resistances between wires, as read out) -> front_end (amplifier, converter)

Module ``patch`` runs this chain for one patch at any time. This package shares no code with the solvers. If
all sizes are zero, the patch is exact: it has point electrodes at the positions of the layout, and its
readings are resistances between isolated pairs of wires.
"""
