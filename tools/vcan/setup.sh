#!/bin/sh
# setup.sh DIR: what vcan-run needs, unpacked into DIR from Debian's packages; no root, unless the package lists
# have to be fetched first. Needs a C compiler for the shim.
set -eu
here=$(dirname "$(readlink -f "$0")")
mkdir -p "$1"
cd "$1"
apt-get -qq download user-mode-linux can-utils 2>/dev/null || {
    apt-get -qq update
    apt-get -qq download user-mode-linux can-utils
}
for package in ./*.deb; do
    dpkg -x "$package" .
    rm "$package"
done
cc -O2 -shared -fPIC -o xstate_shim.so "$here/xstate_shim.c" -ldl
