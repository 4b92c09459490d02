#!/bin/sh
# See that the firmware and the emulated bench can be built: installs three Debian packages where that is allowed,
# otherwise says in one line what will be skipped and what installs it. With CI=true nothing may be skipped.
set -eu
packages="gcc-avr avr-libc libsimavr-dev"

there() {
    command -v avr-gcc >/dev/null 2>&1 || return 1
    echo '#include <avr/io.h>' | avr-gcc -mmcu=atmega328p -E - >/dev/null 2>&1 || return 1
    echo '#include <simavr/sim_avr.h>' | ${CC:-cc} -E - >/dev/null 2>&1
}

there && exit 0
if command -v apt-get >/dev/null 2>&1; then
    as=
    if [ "$(id -u)" -ne 0 ]; then
        as="sudo -n"
        command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null || as=none
    fi
    if [ "$as" != none ]; then
        echo "Installing $packages for the firmware and the emulated bench (once) ..." >&2
        DEBIAN_FRONTEND=noninteractive
        export DEBIAN_FRONTEND
        # An index that is already there will mostly do; it is fetched where it will not.
        $as apt-get install -y -qq --no-install-recommends $packages >/dev/null 2>&1 || {
            $as apt-get update -qq >/dev/null 2>&1 || true
            $as apt-get install -y -qq --no-install-recommends $packages >/dev/null 2>&1 || true
        }
        there && exit 0
    fi
fi
if [ "${CI:-}" = true ]; then
    echo "ambid: the firmware's tests must not be skipped here, and $packages could not be installed" >&2
    exit 1
fi
echo "ambid: tests of the firmware and of the emulated bench are skipped; to run them: sudo apt-get install $packages" >&2
exit 3
