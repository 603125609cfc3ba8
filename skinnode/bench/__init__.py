"""Benchmarks of speed and error, which produce all measured values in the documentation.

::

    cases, truth -> methods (solvers set up for a case) -> verdict, score -> rows -> plots

Each subcommand of ``skinnode bench`` has a module with a function ``run``, which returns the results as plain
values. ``skinnode.cli.bench`` prints the results and writes them to files. ``truth`` simulates presses in
closed form and shares no assumptions with the solvers. ``load``, ``soak`` and ``trust_road`` use frames that
the simulator generates.
"""
