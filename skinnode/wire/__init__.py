"""Deprecated import paths of :mod:`skinnode.protocol`, kept for one version."""
