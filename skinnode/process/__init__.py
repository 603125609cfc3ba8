"""Signals, child processes and pauses of garbage collection."""
