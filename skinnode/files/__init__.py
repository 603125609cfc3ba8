"""Reads and writes files safely: locked, written whole or not at all, with one-line errors."""
