"""The doctor's checks: pure functions that derive findings from facts, one file per area.

The checks do not access a bus. ``run`` calls all checks.
"""
