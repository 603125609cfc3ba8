"""Subcommands of ``skinnode``, one per file.

A subcommand parses its options, prints its result and sets the exit status. It imports what it needs only
when it runs, which keeps ``--help`` fast. Files whose names begin with an underscore contain code shared by
several commands.
"""
