"""Three-dimensional view of a running host or a recording: ``skinnode view``.

Data flows in one direction::

    source (skinnode.monitor) -> bounded queue of fields -> drawing_thread -> tick
        -> drawing_process (child process) -> drawing -> stream of the SDK -> window, browser or file
    recording -> conversion -> tick -> drawing -> stream -> file

``picture`` computes what is drawn of a field, with the shapes in ``geometry``, the colours in ``colours`` and
the places in ``placement``. ``texts`` writes tables in Markdown. ``drawing`` writes both to a recording
``stream``, which ``blueprint`` lays out. ``outputs`` opens windows, pages and files: ``viewer_process`` runs
the viewer as a child process, and ``web_page`` serves it to a browser without access to other computers. Only
``drawing``, ``blueprint`` and ``stream`` require the package rerun-sdk.
"""
