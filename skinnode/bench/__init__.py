"""Benchmarks of speed and error; all measured values in the documentation come from these benchmarks.

Data pass through the modules in this order; ``methods`` sets up the solvers of each case::

    cases, truth -> methods -> verdict, score -> rows of the report -> plots

Each subcommand of ``skinnode bench`` is implemented by a module whose function ``run`` returns the results as
built-in types. ``skinnode.cli.bench`` prints the results and writes them to files. ``truth`` simulates
presses with closed-form models that share no assumptions with the solvers. ``load``, ``scale``, ``soak`` and
``trust_road`` use the simulator, which generates the CAN frames of complete nodes.
"""
