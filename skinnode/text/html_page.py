"""Template for all HTML pages, and a function that escapes untrusted text in them."""

from __future__ import annotations

import html
from collections.abc import Iterable
from string import Template
from typing import Final

from skinnode.text.printable import printable_lines

_PAGE: Final = Template("""\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
</head>
<body>
$body
</body>
</html>
""")


def page(title: str, style: str, body: Iterable[str]) -> str:
    """Return a self-contained HTML page.

    Args:
        title: Title of the page, as plain text.
        style: CSS rules.
        body: HTML elements, in which untrusted text must already be escaped with :func:`escaped`.
    """
    return _PAGE.substitute(title=escaped(title), style=style, body="\n".join(body))


def escaped(text: object) -> str:
    """Return ``text`` with non-printable characters and HTML special characters escaped."""
    return html.escape(printable_lines(str(text)))
