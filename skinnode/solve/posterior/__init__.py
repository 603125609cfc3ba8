"""The whole patch as one Bayesian estimate: ``prior`` of the displacement, ``innovation`` (the linear
algebra of one step), ``estimate`` (the MAP estimate of one frame), ``posterior`` (a stream of frames),
``contacts``.
"""
