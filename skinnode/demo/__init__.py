"""Simulated hand for ``skinnode demo`` and ``skinnode monitor --simulate``: run, score and display.

::

    hand -> vcan_sim.fleet (nodes on a virtual bus) -> skinnode.host -> run (score against the truth) -> view,
    plot

Apart from some benchmarks, only this package imports both the simulator and the host. The two communicate
only over the bus. The true displacements of the simulator are used only for scoring.
"""
