"""Generates the JSON Schema of a hand file.

``python -m skinnode.config.schema`` writes the schema file in the package.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from skinnode.config.descriptions import descriptions_of
from skinnode.config.hand import HandConfig
from skinnode.config.table import Table

SCHEMA_FILE: Final = Path(__file__).with_name("hand.schema.json")
"""Schema file in the package; a test checks that it is up to date."""


def schema_text() -> str:
    """Return the schema as JSON text; the output is deterministic."""
    schema = HandConfig.model_json_schema()
    tables = {table.__name__: table for table in Table.__subclasses__()}
    for name, part in {HandConfig.__name__: schema, **schema["$defs"]}.items():
        for key, text in descriptions_of(tables[name]).items():
            part["properties"][key] = dict(sorted((part["properties"][key] | {"description": text}).items()))
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")
