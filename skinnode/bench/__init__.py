"""Benchmarks of speed and error, the source of every figure in the documentation.

::

    cases, truth -> methods (solvers set up for a case) -> verdict, score -> rows -> plots

Each subcommand of ``skinnode bench`` has a module with a function ``run``, which returns the figures as plain
values; ``skinnode.cli.bench`` prints and writes them. ``truth`` simulates presses in closed form and shares
no assumptions with the solvers. ``load``, ``soak`` and ``trust_road`` take their frames from the
simulator.
"""
