"""Doctor checks: pure functions that derive findings from the facts about a bus.

Each module contains the checks of one area; ``run`` calls all of them.
"""
