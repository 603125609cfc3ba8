"""File access with locks, atomic writes and one-line error messages."""
