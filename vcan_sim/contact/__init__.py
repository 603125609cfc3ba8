"""Contact mechanics of the simulated skin: rigid bodies on an elastic layer that is bonded to a rigid base.

::

    layer (elastic response of the surface) -> grid (response of cells to each other, by FFT)
        -> contact (pressure and friction under a body) -> surface displacement, force

This package shares no code with the solvers or their prior, so it provides an independent ground truth for
testing solvers. Displacements are assumed to be small: the contact is computed for bodies and cells on the
undeformed plane. The x and y axes are along the surface, and z points outwards. A traction is the force per
unit area on the skin; its z component is negative under a body that presses on the skin.
"""
