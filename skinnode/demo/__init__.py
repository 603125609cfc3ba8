"""Runs, scores and displays a simulated hand for ``skinnode demo`` and ``skinnode monitor --simulate``.

::

    hand -> vcan_sim.fleet (nodes on a virtual bus) -> skinnode.host -> run (score against the truth) -> view,
    plot

Apart from some benchmarks, only this package imports both the simulator and the host. The two communicate
only over the bus. The simulator's true displacements are used only for scoring.
"""
