"""Signals, child processes and garbage collector settings of a running program."""
