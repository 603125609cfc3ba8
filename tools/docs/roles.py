"""Show docstring roles such as :class:`~skinnode.model.frames.FieldFrame` as code in the documentation."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":[a-z]+:`~?(?:[\w.]+\.)?([\w.]+)`")


class Roles(griffe.Extension):
    """Griffe extension that replaces roles in docstrings when Griffe loads a module."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = (
                _ROLE.sub(r"`\1`", obj.docstring.value).replace("``", "`").replace("::\n", ":\n")
            )
