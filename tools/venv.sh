#!/bin/sh
# Make the virtual environment: sh tools/venv.sh FOLDER [PYTHON]
# Takes PYTHON where given, else the first python3 that is 3.11 or newer. An environment that already works is kept,
# unless it is of another version than the PYTHON asked for.
set -eu
folder=$1
wanted=${2:-}

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

version() { "$1" -c 'import sys; print(sys.version_info[:2])' 2>/dev/null; }

if new_enough "$folder/bin/python" && "$folder/bin/python" -m pip --version >/dev/null 2>&1; then
    if [ -z "$wanted" ] || [ "$(version "$wanted")" = "$(version "$folder/bin/python")" ]; then
        exit 0
    fi
fi

python=
for candidate in ${wanted:-python3 python3.13 python3.12 python3.11}; do
    if new_enough "$candidate"; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    echo "ambid: no Python 3.11 or newer found (tried: ${wanted:-python3 python3.13 python3.12 python3.11})." >&2
    echo "  Install one (Debian 12 and newer: apt-get install python3 python3-venv), or name it: make setup PYTHON=/path/to/python3" >&2
    exit 1
fi
if ! "$python" -c 'import venv, ensurepip' >/dev/null 2>&1; then
    echo "ambid: $python has no venv module; the environment cannot be made." >&2
    echo "  Install it (Debian: apt-get install python3-venv), or name another Python: make setup PYTHON=/path/to/python3" >&2
    exit 1
fi
"$python" -m venv --clear "$folder"
