"""Simulator that runs a hand's patches as CANopen nodes, pressed by a simulated indenter.

::

    scene (true deformation) -> skin (the patch as manufactured and read out) -> sensor (readings, wire
    faults)
        -> faulty_node (the real node) -> faulty_scans (scan faults) -> fleet (all nodes on their buses)
        -> command (vcan-sim)

A patch's scene comes from the module ``scene`` (random strokes) or, with a scene file, from ``scenes``.
``contact`` computes contact mechanics on a bonded layer for ``scenes``, independently of all models in
``skinnode``. ``smooth`` defines smooth ramps. ``virtual_time`` is a clock that jumps from event to event.
``timed_bus`` is a CAN bus with exact times, arbitration, errors and error counters; ``timed_interface`` is
the python-can interface to this bus in virtual time, and ``trace`` records its frames. ``pytest_plugin`` and
``testing`` provide fixtures and helpers for tests of other programs. ``faults``
declares the faults, ``injector`` draws and counts faults, and ``tally`` counts frames by kind.
"""
