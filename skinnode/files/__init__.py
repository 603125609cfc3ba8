"""Files that a crash or bad input cannot spoil: locked, written whole or not at all, with one-line errors."""
