"""Full-screen view of a running host or a recording: ``skinnode monitor``.

The modules form a pipeline. ``source`` takes snapshots of a host or a recording without blocking the host.
``view_model`` converts snapshots to an immutable view, and ``touches`` finds contacts in a field.
``field_map`` draws fields as text; ``patch_panel`` and ``screen`` lay out the lines of the screen. ``app``
shows these lines and handles keys; ``widgets`` and ``terminal_driver`` send only changed lines to the
terminal. ``report`` writes the view as JSON and collects faults. Only ``app``, ``widgets`` and
``terminal_driver`` require the package textual.
"""
