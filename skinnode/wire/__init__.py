"""Old paths of :mod:`skinnode.protocol`, for one version."""
