"""Bayesian estimate of a whole patch, tracked through a stream of frames.

``posterior`` is the entry point: it estimates a field from each frame and tests the readings.
``frame_estimator`` estimates the field without testing the readings.

``observation`` converts a frame to weighted residuals. ``gating`` uses χ² tests to find the wires that moved.
``map_estimate`` computes the maximum a posteriori (MAP) displacement; the linear algebra of its steps is in
``measurement_update``. ``geometry_error`` models manufacturing errors within the tolerances of a patch.

The prior combines the elasticity of the rubber (``elastic_prior``, ``load_cells``) with the expected loads
(``load_prior``), which ``local`` concentrates in a few discs. ``hyperparameters`` estimates the scale of the
prior and the noise. ``load_posterior`` estimates the loads of a frame, ``contact_regions`` divides them into
contacts, and ``contacts`` measures each contact. ``data_share`` computes the fraction of a displacement that
the data determine.
"""
