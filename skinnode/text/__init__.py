"""Text output: numbers with nouns, printable characters, HTML pages and JSON values."""
