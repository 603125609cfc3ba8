"""Helpers for text output: plural forms, printable characters, HTML pages and JSON values."""
