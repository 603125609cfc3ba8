"""The operators Gauss-Newton, Levenberg-Marquardt and dogleg (one file each), and their workspace ``work``.

``trust_region`` decides whether to accept a step, and ``loop`` iterates the operator selected by its number
in ``codes``. ``system`` solves any square or tall system in one or more attempts (``attempt``), ``minimum``
tests and refines a minimum whose residual is not zero, and ``result`` defines the outcome.
"""
