"""Plots benchmark results; requires matplotlib.

``ratios`` plots the benchmarks ``kernel`` and ``solve``. Every other module is named after the benchmark that
it plots.
"""
