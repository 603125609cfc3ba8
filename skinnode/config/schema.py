"""Generates the JSON Schema of a hand file.

``python -m skinnode.config.schema`` writes the schema file in the package.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from skinnode.config.hand import HandConfig

SCHEMA_FILE: Final = Path(__file__).with_name("hand.schema.json")
"""Schema file in the package; a test checks that it is up to date."""


def schema_text() -> str:
    """Return the schema as JSON text; the output is deterministic."""
    schema = HandConfig.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")
