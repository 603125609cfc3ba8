"""Contact mechanics of the simulated skin: rigid bodies on an elastic layer bonded to a rigid base.

::

    layer (elastic response of the surface) -> grid (response of the cells, by FFT)
        -> contact (pressure and friction under a body) -> surface displacement, force

This package shares no code with the solvers, so its ground truth is independent of them. Displacements are
assumed to be small, and contacts are computed in the plane of the undeformed surface. The x and y axes lie in
the surface, and z points outwards. A traction is a force per unit area on the skin; where a body presses, its
z component is negative.
"""
