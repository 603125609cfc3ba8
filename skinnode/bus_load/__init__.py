"""Bandwidth that a hand needs on its buses.

``stuffing`` counts bits, ``timing`` computes frame durations, ``response`` bounds the worst-case
latency, and ``plan`` combines these for a hand.
"""
