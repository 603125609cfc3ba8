"""Bayesian estimate of a whole patch, tracked through a stream of frames.

``posterior`` is the entry point: it estimates a field from each frame and tests the readings.
``frame_estimator`` does the same without the test.

``observation`` converts each frame to residuals with weights. ``gating`` uses χ² tests to find the wires that
moved. ``map_estimate`` computes the maximum a posteriori (MAP) displacement; ``measurement_update`` contains
the linear algebra of one step. ``geometry_error`` models the manufacturing errors of a patch within its
tolerances.

The prior combines the elasticity of the rubber (``elastic_prior``) with the expected loads (``load_prior``).
``hyperparameters`` estimates the scale of the prior and the noise. ``load_posterior`` estimates the loads of
a frame, ``contact_regions`` divides them into contacts, and ``contacts`` measures each contact.
``data_share`` computes how much of a displacement is determined by the data rather than by the prior.
"""
