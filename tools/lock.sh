#!/bin/sh
# Pin every version again, with the hashes of all its files and without any index address: sh tools/lock.sh PYTHON
# The oldest supported Python resolves, so that the pins suit all: run it with 3.11.
set -eu
python=$1
"$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || {
    echo "ambid: the versions are resolved with Python 3.11, the oldest supported: make distclean; make lock PYTHON=python3.11" >&2
    exit 1
}
"$python" -m venv --clear build/lock
build/lock/bin/python -m pip install -qq --require-hashes -r requirements/lock.txt

# Its own settings, not the machine's: an additional local index would put hashes here that nobody else can match.
export PIP_CONFIG_FILE=/dev/null
unset PIP_EXTRA_INDEX_URL PIP_FIND_LINKS || true

compile() {
    build/lock/bin/pip-compile --quiet --upgrade --generate-hashes --allow-unsafe --no-strip-extras --no-config --no-header \
        --no-emit-index-url --no-emit-find-links --no-emit-trusted-host -o "$@"
}
compile requirements/lock.txt requirements/lock.in
compile requirements/build.txt requirements/build.in
compile requirements/base.txt pyproject.toml
compile requirements/dev.txt pyproject.toml requirements/dev.in
compile requirements/docs.txt requirements/docs.in
compile requirements/peers-linear.txt requirements/peers-linear.in
compile requirements/peers-tracking.txt requirements/peers-tracking.in
compile requirements/peers-rotor.txt requirements/peers-rotor.in
if grep -n '://' requirements/*; then
    echo "ambid: an address got into the requirements (above)" >&2
    exit 1
fi
