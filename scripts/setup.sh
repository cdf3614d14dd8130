#!/usr/bin/env bash
# Makes the virtual environment VENV unless a usable one is there, and installs koopdqn into it, editable, with
# the releases that CONSTRAINTS pins; empty, with the newest that are allowed. Touches nothing outside VENV.
# Usage: scripts/setup.sh VENV [PYTHON [CONSTRAINTS]]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=$1
wanted=${2:-}
constraints=${3-constraints.txt}
need="koopdqn needs Python 3.11 or later with its venv module (Debian, Ubuntu: the package python3-venv)"

# Running it is the only sure test: a version manager's shim may be on PATH and lead nowhere.
usable() { "$1" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

choose_python() {
    local candidate
    if [[ -n $wanted ]]; then
        usable "$wanted" && echo "$wanted" && return
        echo "PYTHON=$wanted cannot be used: $need; it says: $("$wanted" --version 2>&1 || true)" >&2
        return 1
    fi
    for candidate in python3.11 python3 python3.12 python3.13 python3.14; do
        usable "$candidate" && echo "$candidate" && return
    done
    echo "no usable Python on PATH: $need; found: $(python3 --version 2>&1 || true)" >&2
    return 1
}

if ! usable "$venv/bin/python"; then
    if [[ -e $venv && ! -e $venv/pyvenv.cfg ]]; then
        echo "VENV=$venv exists and is no virtual environment; move it away or choose another VENV" >&2
        exit 1
    fi
    python=$(choose_python)
    echo "making $venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
fi

echo "installing koopdqn into $venv; the first time this takes some minutes"
"$venv/bin/python" -m pip install -qq --disable-pip-version-check ${constraints:+-c "$constraints"} -e '.[dev]'
