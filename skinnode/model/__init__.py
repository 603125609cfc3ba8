"""Physical and geometric model of a patch, consisting of immutable values and pure functions.

``layout`` and ``layout_file`` define the electrodes at rest, ``forward`` and ``kernels`` compute resistances
from positions, and ``elastic`` computes displacements from loads. ``frames``, ``status`` and ``data_fault``
define the inputs and results of a solver. ``distrust`` explains why a result is not trusted, and
``tolerances`` defines how far a patch may differ from its layout. ``pose`` and ``hand_contact`` express
contacts in the coordinate frames of a robot's links and of the hand.
"""
