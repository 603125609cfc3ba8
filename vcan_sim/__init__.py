"""Simulator that runs a hand's patches as CANopen nodes, pressed by a simulated indenter.

::

    scene (true deformation) -> skin (the patch as made and read out) -> sensor (readings, wire faults)
        -> faulty_node (the real node) -> faulty_scans (scan faults) -> fleet (all nodes on their buses)
        -> command (vcan-sim)

The scene of a patch is a stroke of ``scene`` or, from a scene file, of ``scenes``. ``contact`` has contact
mechanics on a bonded layer, apart from all models of the product; ``scenes`` uses it. ``smooth`` has smooth
ramps. ``virtual_time`` is a clock that jumps from event to event. ``timed_bus`` is a CAN bus with exact
times, arbitration, errors and error counters; ``timed_interface`` is its interface for python-can in virtual
time, and ``trace`` records it. ``pytest_plugin`` and ``testing`` serve tests of other programs. ``faults``
declares the faults, ``injector`` draws and counts faults, ``tally`` counts frames by kind.
"""
