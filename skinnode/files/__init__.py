"""File access: size limits, atomic writes, lock files, and errors with one-line messages."""
