"""Contact mechanics of the simulated skin: rigid bodies on an elastic layer that is bonded to a rigid base.

::

    layer (elastic response of the surface) -> grid (response of the cells, by FFT)
        -> contact (pressure and friction under a body) -> surface displacement, force

This package shares no code with the solvers, so it provides an independent ground truth for tests of the
solvers. Displacements are assumed to be small, and contacts are computed in the plane of the undeformed
surface. The x and y axes are parallel to the surface, and the z axis points outwards. A traction is a force
per unit area that acts on the skin. The z component of the traction is negative where a body presses on the
skin.
"""
