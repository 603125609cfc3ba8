"""Clock, signal handling, child processes and garbage collection of a running program."""
