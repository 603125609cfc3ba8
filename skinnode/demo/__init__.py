"""Bring up, solve, score and show a simulated hand, for ``skinnode demo`` and ``--simulate``.

::

    hand -> vcan_sim.fleet (nodes on a virtual bus) -> skinnode.host -> run (score against the truth) -> view,
    plot

Only this package and two benchmarks import both simulator and host. The two communicate only through
the bus; the simulator's truth is used only for scoring.
"""
