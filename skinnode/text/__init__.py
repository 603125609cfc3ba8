"""Text output: counted nouns, printable characters, HTML pages and JSON values."""
