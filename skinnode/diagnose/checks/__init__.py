"""The doctor's checks: pure functions from facts to findings, one file per area.

They do not access a bus. ``run`` calls all of them.
"""
