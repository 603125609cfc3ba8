"""Plots benchmark results; requires matplotlib.

``ratios`` plots the benchmarks ``kernel`` and ``solve``. Each other module has the name of the benchmark that
it plots.
"""
