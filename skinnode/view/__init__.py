"""Three-dimensional view of a running hand or a recording: ``skinnode view``.

Data flows in one direction::

    source (skinnode.monitor) -> bounded queue of fields -> drawing_thread -> tick
        -> drawing_process (child process) -> drawing -> stream of the SDK -> window, browser or file
    recording -> conversion -> tick -> drawing -> stream -> file (file_conversion)

``picture`` computes a field's picture, using shapes from ``geometry`` and colours from ``colours``;
``placement`` places the patches. ``texts`` writes Markdown tables. ``drawing`` writes pictures and tables to
a recording ``stream``; ``blueprint`` defines the window layout. ``outputs`` opens windows, pages and files:
``viewer_process`` runs the viewer as a child process, and ``web_page`` serves it to a browser without
contacting other computers. Only ``drawing``, ``blueprint`` and ``stream`` require the rerun-sdk package.
"""
