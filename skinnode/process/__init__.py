"""Process-wide facilities: clock, signals, child processes, garbage collection and resource cleanup."""
