"""Plots of benchmarks, which need matplotlib.

``ratios`` serves ``kernel`` and ``solve``; the other modules are named after their benchmarks.
"""
