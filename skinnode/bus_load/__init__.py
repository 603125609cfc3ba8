"""Computes the bus load and the worst-case response times of a hand.

``stuffing`` counts bits with the compiled ``stuffing_kernels``, ``timing`` computes frame durations,
``response`` computes worst-case response times, and ``plan`` applies them to a hand.
"""
