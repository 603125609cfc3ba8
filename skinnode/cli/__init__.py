"""Subcommands of ``skinnode``, one file each: options in, text and exit status out. No logic of their own."""
