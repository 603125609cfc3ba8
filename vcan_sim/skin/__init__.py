"""Imperfect patches: how a patch and its read-out deviate from the layout file.

::

    imperfections (sizes and seed) -> body (actual electrode positions)
    scene -> history (hysteresis and creep of the rubber) -> forward (conductance of each path)
        -> crossbar (resistances between wires, as read out) -> front_end (amplifier, converter)

The module ``patch`` combines these steps for one patch. The package shares no code with the solvers. With all
sizes zero, the patch is exact: its point electrodes are where the layout file says, and a reading is the
resistance of an isolated pair of wires.
"""
