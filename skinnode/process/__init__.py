"""Signal handling, child processes and garbage collection in a running program."""
