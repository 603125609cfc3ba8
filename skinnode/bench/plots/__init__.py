"""Plots of benchmarks. ``ratios`` serves ``kernel`` and ``solve``; the rest are named after their benchmark.

They need matplotlib.
"""
