"""The doctor's checks: pure functions from facts to findings, one file per area.

The checks do not access a bus. ``run`` calls all checks.
"""
