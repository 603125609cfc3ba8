"""Full-screen view of a running hand or a recording: ``skinnode monitor``.

``source`` defines the interface of the data sources: ``live_source`` takes snapshots of a host or a remote
hand without blocking the host, and ``replay_source`` takes snapshots of a recording. ``view_model`` converts
snapshots to an immutable view, including the contacts that ``touches`` finds in a field. ``field_map`` draws
fields as text, and ``patch_panel`` and ``screen`` lay out the lines of the screen. ``app`` shows these lines
and handles keys; ``widgets`` and ``terminal_driver`` send the lines that have changed to the terminal.
``session_faults`` collects faults and reports the view as JSON. Only ``app``, ``widgets`` and
``terminal_driver`` require the textual package.
"""
