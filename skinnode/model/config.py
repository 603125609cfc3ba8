"""Former path of :mod:`skinnode.config`, kept for one version."""

from skinnode.moved import moved

__getattr__ = moved(__name__, "skinnode.config")
