"""Plots of benchmark results; these modules require matplotlib.

``ratios`` plots the benchmarks ``kernel`` and ``solve``; the other modules are named after their benchmarks.
"""
