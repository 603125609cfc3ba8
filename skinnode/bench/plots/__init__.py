"""Plots of benchmarks, one module per benchmark. They need matplotlib."""
