"""Deprecated import path of :mod:`skinnode.protocol.codec`, kept for one version."""

from skinnode.moved import moved

__getattr__ = moved(__name__, "skinnode.protocol.codec")
