"""Subcommands of ``skinnode``, one per file.

A subcommand parses its options, prints its result and sets the exit status. Each file imports its
dependencies only when its command runs, which keeps ``--help`` fast. Files whose names begin with an
underscore contain code shared by several commands.
"""
