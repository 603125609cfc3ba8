"""A simulated hand, brought up, solved, scored and shown, for ``skinnode demo`` and ``--simulate``.

::

    hand -> vcan_sim.fleet (nodes on a virtual bus) -> skinnode.host -> run (score against the truth) -> view,
    plot

This package and two benchmarks are the only ones that import both simulator and host. Both communicate only
through the bus; the simulator's truth is used for the score alone.
"""
