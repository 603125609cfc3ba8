"""A hand on a full screen: what `skinnode monitor` shows, and how it gets it without a host noticing.

``source`` reads a running host or a recording, ``state`` makes a frozen view of that, ``paint`` and ``maps``
make coloured text of the view, and ``app`` puts it on the terminal. Only the last needs textual.
"""
