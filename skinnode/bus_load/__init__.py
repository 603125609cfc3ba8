"""Computes the bandwidth that a hand needs on its buses.

``stuffing`` counts bits, ``timing`` computes frame durations, ``response`` bounds the worst-case
latency, and ``plan`` combines the results for a hand.
"""
