"""Subcommands of ``skinnode``, one file each, which parse options and return text and an exit status.

A file imports its dependencies only when its command runs, so that ``--help`` responds at once. Files whose
names begin with an underscore are shared by several commands.
"""
