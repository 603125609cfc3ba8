"""Local prior: expects loads in a few soft discs, and hardly any elsewhere.

``discs`` contains the discs, their evidence and the search in the space of their parameters. ``disc_search``
fits the discs to a frame, and computes how much the displacement depends on the choice of discs.
"""
