"""Subcommands of ``skinnode``, one per file: each parses options, prints its result and sets the exit status.

A file imports its dependencies only when its command runs, so that ``--help`` responds at once. Several
commands share the files with a leading underscore in their names.
"""
