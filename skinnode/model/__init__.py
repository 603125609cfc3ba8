"""Physical and geometric model of a patch: immutable values and pure functions.

``layout`` and ``layout_file`` define the electrode positions at rest, and ``tolerances`` defines how far a
patch may deviate from them. ``forward`` and ``kernels`` compute resistances from positions. ``elastic`` and
``bonded_layer`` compute displacements from loads. ``frames``, ``status`` and ``data_fault`` define the inputs
and results of a solver, and ``distrust_text`` explains why a result is not trusted. ``pose`` and
``hand_contact`` express contacts in the frames of the robot's links and of the hand.
"""
