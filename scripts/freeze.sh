#!/usr/bin/env bash
# Prints the constraints file for what an environment holds.
# Usage: scripts/freeze.sh PYTHON
set -euo pipefail

cat <<'HEADER'
# Every package koopdqn is tested with, direct or not. Written by `make constraints`; do not edit.
# Local versions (torch's +cpu) are cut off, so that any build of a release satisfies its line.
HEADER
"$1" -m pip --disable-pip-version-check list --format=freeze --exclude-editable --exclude pip \
    | sed -E 's/\+[^ ]*$//' | LC_ALL=C sort -f
