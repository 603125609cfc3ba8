"""Speed and accuracy benchmarks, the source of every measured value in the documentation.

Data flow through the modules in this order; ``methods`` sets up the solvers for each case::

    cases, truth -> methods -> verdict, score -> rows of the report -> plots

Each subcommand of ``skinnode bench`` has a module whose ``run`` function returns the results as built-in
types. ``skinnode.cli.bench`` prints the results and writes them to files. ``truth`` simulates presses with
closed-form models that share no assumptions with the solvers. ``memory`` measures the process's memory use.
``load``, ``scale``, ``real_time``, ``soak`` and ``trust_road`` use the simulator, in which complete nodes
generate the CAN frames. ``family_scenes`` uses only the simulator's contact mechanics.
"""
