"""Subcommands of ``skinnode``, one per file.

Every subcommand parses its options, prints its result and sets the exit status. A file imports its
dependencies only when its command runs, so that ``--help`` prints without delay. Files whose names start with
an underscore contain code shared by several commands.
"""
