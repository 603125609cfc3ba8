#!/bin/sh
# Compare eds/ with the files generated from the profile, and check each file with an independent parser (dcf-tools).
set -eu
cd "$(dirname "$0")/.."
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT
.venv/bin/python -m skinnode.protocol.profile "$made"
diff -r eds "$made"
for file in eds/*.eds; do .venv/bin/dcfchk -n 1 "$file"; done
