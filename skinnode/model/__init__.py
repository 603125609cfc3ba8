"""Model of a patch, as values and pure functions.

``layout`` and ``layout_file`` define the electrodes at rest, ``forward`` and ``kernels`` compute resistances
from positions, ``elastic`` computes displacements from loads, and ``pose`` transforms vectors and points from
a patch's frame to the hand's frame. ``frames`` and ``status`` define the inputs and results of a solver.
"""
