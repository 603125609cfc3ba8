"""Process-wide facilities: clock, signals, child processes, garbage collection, closing of resources."""
