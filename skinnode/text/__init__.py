"""Text output: plural forms, printable characters, HTML pages and JSON values."""
