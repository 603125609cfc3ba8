"""Descriptions of the keys of a hand file, for its JSON Schema and for the documentation.

The description of a key is the docstring below it in the source code. Pydantic's own option
``use_attribute_docstrings`` would parse the source code of all tables every time a command starts.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from itertools import pairwise

from skinnode.config.table import Table


def descriptions_of(table: type[Table]) -> dict[str, str]:
    """Return the description of each key of ``table`` that has one.

    Args:
        table: Class of a table. Inherited keys are included.
    """
    found: dict[str, str] = {}
    for each in reversed(table.__mro__):
        if issubclass(each, Table) and each is not Table:
            (definition,) = ast.parse(textwrap.dedent(inspect.getsource(each))).body
            assert isinstance(definition, ast.ClassDef)
            for pair in pairwise(definition.body):
                match pair:
                    case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(ast.Constant(str(text))):
                        found[name] = inspect.cleandoc(text)
    return found
