"""Safe file access: locks, atomic writes and one-line errors."""
