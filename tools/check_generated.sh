#!/bin/sh
# Compare what is generated with what is in the repository: eds/ from the profile, each file checked with an independent
# parser (dcf-tools), and the JSON Schema of hand.toml from the configuration.
set -eu
cd "$(dirname "$0")/.."
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT
mkdir "$made/eds"
.venv/bin/python -m skinnode.protocol.profile "$made/eds"
diff -r eds "$made/eds"
for file in eds/*.eds; do .venv/bin/dcfchk -n 1 "$file"; done
.venv/bin/python -c 'from skinnode.config.schema import schema_text; print(schema_text(), end="")' >"$made/schema.json"
diff skinnode/config/hand.schema.json "$made/schema.json"
