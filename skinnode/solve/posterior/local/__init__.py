"""Local prior: expects loads in a few soft discs, and hardly any elsewhere.

``discs`` defines the discs, computes their evidence and searches their parameter space. ``load_effects``
computes the effects of loads on a frame. ``disc_search`` fits the discs to a frame, and computes how much the
displacement depends on the choice of discs. ``disc_claim`` computes the standard deviations.
"""
