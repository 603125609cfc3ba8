"""Process-wide facilities: clock, signal handling, child processes and garbage collection."""
