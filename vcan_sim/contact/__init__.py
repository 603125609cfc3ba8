"""Contact mechanics of the simulated skin: rigid bodies on an elastic layer that is bonded to a rigid base.

::

    layer (elastic response of the surface) -> grid (response of cells to each other, by FFT)
        -> contact (pressure and friction under a body) -> surface displacement, force

This room shares no code with a solver or its prior: it is the independent truth that solvers are tested
against. Displacements are small: the surface moves, but bodies and cells stay on the undeformed plane.
Coordinates: x and y along the surface, z outwards. A traction is a force per area on the skin, so a pressing
one has a negative z.
"""
