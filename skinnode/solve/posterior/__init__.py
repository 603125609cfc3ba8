"""Bayesian estimate of a whole patch, tracked through a stream of frames.

The entry point is ``posterior``, which turns a stream of frames into fields and tests their readings;
``frame_estimator`` solves a frame from the readings it is given. Each frame becomes an ``observation``;
``gating`` tests by χ² which wires moved; ``map_estimate`` finds the maximum a posteriori displacement in
steps of ``measurement_update`` (the linear algebra of one step); ``geometry_error`` adds the errors of a
patch made to tolerances. The prior combines elasticity (``elastic_prior``) with expected loads
(``load_prior``); ``hyperparameters`` sets the prior's scale and the noise from the evidence.
``load_posterior`` estimates the loads of a frame, ``contact_regions`` divides them into contacts,
``contacts`` measures each contact, and ``data_share`` says how much of a field comes from the data.
"""
