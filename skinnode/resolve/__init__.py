"""Solves recordings again, with different options or calibrations, in several processes or on a Dask cluster.

Data flows in one direction::

    settings -> plan -> units -> workers: processes (this computer) or cluster (Dask) -> results

``settings`` parses the options and applies them to the hand of a recording; their combinations are variants.
``plan`` divides the work into units, and ``run`` passes each unit to the workers as soon as the units that it
needs are finished. There are three kinds of ``units``:

- ``scan_capture`` assembles the scans of some buses from the frames and checks their codes,
- ``patch_solver`` solves the scans of one patch with the options of one variant,
- ``result_file`` writes the fields of all patches to one file, in the order of a replay.

Each patch's stream is stateful, but the streams do not affect each other. Every unit is therefore independent
and repeatable: its result does not depend on where, when or how often it is run. Each result is a file in the
work folder (``part_files``), which appears only when it is complete. If the command is repeated, it finds
these files and continues. A lost worker costs only its current unit. ``identity`` describes the software of a
worker, which must be the same for all workers.
"""
