"""Computes the bus load and worst-case latencies of a hand.

``stuffing`` counts bits, ``timing`` computes frame durations, ``response`` computes worst-case response
times, and ``plan`` applies them to a hand.
"""
