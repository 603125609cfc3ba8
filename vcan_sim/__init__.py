"""The simulator: the patches of a hand as CANopen nodes, pressed by a simulated indenter.

::

    scene (true deformation) -> sensor (resistances, faults of wires) -> faulty_node (the real node)
        -> faulty_scans (faults of scans) -> fleet (all nodes on their buses) -> command (vcan-sim)

``faults`` declares what can be injected, ``injector`` draws and counts it, ``tally`` counts frames by kind.
"""
