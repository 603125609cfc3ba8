"""Simulator that runs the patches of a hand as CANopen nodes, pressed by simulated bodies.

::

    scene (true deformation) -> skin (patch with manufacturing errors) -> sensor (resistance readings)
        -> faulty_node (node with faults) -> faulty_scans (scan faults) -> fleet (all nodes and buses)
        -> commands (vcan-sim)

The module ``scene`` generates random strokes, and ``scenes`` reads scene files. For scene files, ``contact``
computes the contact mechanics of a bonded layer, independently of all models in ``skinnode``. ``smooth``
defines smooth ramps. ``virtual_time`` provides a clock that jumps from event to event. ``timed_bus``
simulates a CAN bus with bit times, arbitration, error frames and error counters. ``timed_interface`` provides
access to this bus through python-can, and ``trace`` records the frames on this bus. ``pytest_plugin`` and
``testing`` provide fixtures and helpers for tests of other programs. ``faults`` declares the faults,
``injector`` draws and counts faults, and ``tally`` counts frames by kind.
"""
