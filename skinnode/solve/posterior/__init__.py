"""The whole patch as one Bayesian estimate, followed through a stream of frames.

``posterior`` is the entry: a stream of frames in, fields out. Each frame becomes an ``observation``;
``gating`` tests by χ² which wires moved; ``map_estimate`` finds the maximum a posteriori displacement by
steps of ``measurement_update`` (the linear algebra of one step). The prior is ``prior`` (elasticity) with
the loads of ``load_prior``; ``hyperparameters`` sets its scale and the noise by the evidence.
``load_posterior`` gives the loads after a frame, and ``contacts`` what they form.
"""
