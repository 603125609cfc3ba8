"""The doctor's checks: pure functions from facts to findings, one file for each area.

They know nothing of buses; ``run`` calls them all.
"""
