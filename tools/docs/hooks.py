"""MkDocs hooks that replace each `<!-- generated: NAME -->` line with a table generated from the code.

The build fails if NAME is not a known table, or if a table is not used on any page.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import command_pages
import hand_keys
import health_tables
import protocol_tables
import solver_constants
from mkdocs.exceptions import PluginError

TABLES: dict[str, Callable[[], str]] = {
    **hand_keys.TABLES,
    **protocol_tables.TABLES,
    **health_tables.TABLES,
    **command_pages.TABLES,
    **solver_constants.TABLES,
}
_MARK = re.compile(r"^<!-- generated: ([\w-]+) -->$", flags=re.MULTILINE)
_used: set[str] = set()


def on_pre_build(**_: Any) -> None:
    _used.clear()


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    def made(mark: re.Match[str]) -> str:
        name = mark[1]
        if name not in TABLES:
            raise PluginError(f"{page.file.src_path}: got generated: {name}, allowed: {', '.join(TABLES)}")
        _used.add(name)
        return TABLES[name]()

    return _MARK.sub(made, markdown)


def on_env(env: Any, **_: Any) -> Any:
    if unused := sorted(TABLES.keys() - _used):
        raise PluginError(f"no page contains <!-- generated: {unused[0]} -->")
    return env
