"""Computes the bus load and the worst-case response times of a hand.

``stuffing`` counts bits, ``timing`` computes frame durations, ``response`` computes worst-case response
times, and ``plan`` applies them to a hand.
"""
