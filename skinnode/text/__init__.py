"""Text for people and machines: plural forms, printable characters, JSON values."""
