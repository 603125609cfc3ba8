"""Model of a patch, as values and pure functions.

``layout`` and ``layout_file`` hold the electrodes at rest, ``forward`` and ``kernels`` turn positions into
resistances, ``elastic`` turns loads into displacements, ``pose`` turns a patch into the hand's frame.
``frames`` and ``status`` are what a solver takes and returns.
"""
