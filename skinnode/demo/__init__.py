"""A hand that is simulated, gathered and shown: ``skinnode demo`` and the simulated hands of other commands.

This package and two benchmarks are the only ones that know the simulator as well as the host. Both talk only
through the bus; the truth that the simulator keeps is used for the score alone.
"""
