"""Benchmarks: speed beside error, each figure of the documentation.

::

    cases, truth -> methods (solvers of ours and of others) -> verdict, score -> rows -> plots

One module per subcommand of ``skinnode bench`` with a function ``run``, which returns the figures as plain
values; ``skinnode.cli.bench`` prints and writes them. ``truth`` simulates presses on a finer grid than
the solver's and by another load model; ``load`` and ``soak`` take their frames from the simulator.
"""
