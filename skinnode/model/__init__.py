"""What a patch is, as values and pure functions: ``layout`` (electrodes at rest), ``forward`` and ``kernels``
(displacement to resistance), ``elastic`` (load to displacement), ``pose`` (patch to hand), ``frames`` and
``status`` (what a solver takes and returns).
"""
