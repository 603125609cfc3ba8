"""Full-screen view of a running host or a recording: ``skinnode monitor``.

Data flows in one direction: ``source`` takes snapshots of a host or a recording without delaying it,
``view_model`` condenses snapshots into a frozen view, ``touches`` finds contacts in a field, ``field_map``
draws fields, ``patch_panel`` and ``screen`` lay out the lines of text, ``app`` shows them and handles keys,
``widgets`` and ``terminal_driver`` write only what changed. ``report`` writes the view as JSON and collects
faults. Only ``app``, ``widgets`` and ``terminal_driver`` need textual.
"""
