"""Subcommands of ``skinnode``, one file each: options in, text and exit status out, no logic of their own.

A file imports its dependencies only when its command runs, so that ``--help`` responds at once. Files that
begin with an underscore serve several commands.
"""
