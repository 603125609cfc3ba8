#!/bin/sh
# setup.sh DIR: unpack the Debian packages that vcan-run requires into DIR, and compile the shim. Requires a C
# compiler, and root if the package lists must be fetched first.
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
