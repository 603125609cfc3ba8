"""Computes the bus load and worst-case latencies of a hand.

``stuffing`` counts bits, ``timing`` computes frame durations, ``response`` computes worst-case latencies, and
``plan`` combines these results for a hand.
"""
