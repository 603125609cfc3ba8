"""Simulates a hand whose patches run as CANopen nodes and are touched by simulated bodies.

::

    scene (true deformation) -> skin (patch with manufacturing errors) -> sensor (resistance readings)
        -> faulty_node (node with faults) -> faulty_scans (scan faults) -> fleet (all nodes and buses)
        -> commands (vcan-sim)

``scene`` generates random strokes, and ``scenes`` plays scene files. For scene files, ``contact`` computes
the contact mechanics of a bonded layer, independently of the models in ``skinnode``. ``smooth`` contains
motion profiles. ``virtual_time`` is a clock that jumps from event to event. ``timed_bus`` simulates a CAN bus
with bit times, arbitration, error frames and error counters. ``timed_interface`` makes this bus available to
python-can, and ``trace`` records its frames. ``pytest_plugin`` and ``testing`` contain fixtures and helpers
for the tests of other programs. ``faults`` declares the faults, ``injector`` draws and counts them, and
``tally`` counts frames by kind.
"""
