"""The simulated skin as it is made and read out: how far a patch departs from its layout file.

::

    imperfections (sizes and seed) -> body (electrodes as they lie)
    scene -> history (hysteresis and creep of the rubber) -> forward (conductance of each path)
        -> crossbar (resistances between wires, as read out) -> front_end (amplifier, converter)

``patch`` runs this chain for one patch and any time. Nothing here shares code with a solver. Sizes of zero
leave the exact patch: point electrodes at the places of the layout, and resistances between isolated pairs of
wires.
"""
