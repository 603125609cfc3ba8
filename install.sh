#!/bin/sh
# install.sh [EXTRA]: make the virtual environment .venv beside this file and install skinnode into it.
#   sh install.sh          what a robot needs, and plots
#   sh install.sh tui      what a robot needs, and the full screen of skinnode monitor
#   sh install.sh mcap     what a robot needs, and recordings as MCAP
#   sh install.sh parquet  what a robot needs, and tables of fields as Parquet
#   sh install.sh cluster  what a robot needs, and skinnode resolve on a Dask cluster
#   sh install.sh view     what a robot needs, and the three-dimensional view (770 MB)
#   sh install.sh zenoh    what a robot needs, and fields for other processes over Zenoh
#   sh install.sh bench    what a robot needs, and Ceres to measure against
#   sh install.sh test     the first, editable, with everything the tests use
# Needs Python 3.11 or newer (PYTHON=... chooses one). On a Debian without the venv module it installs that first.
set -eu
cd "$(dirname "$0")"
python=${PYTHON:-python3}
extra=${1:-plot}
case $extra in
    plot | tui | view | mcap | parquet | cluster | zenoh | bench | test) ;;
    *) echo "install.sh: got $extra, allowed: plot, tui, view, mcap, parquet, cluster, zenoh, bench or test" >&2; exit 2 ;;
esac

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "install.sh: $("$python" --version 2>&1) at $python, needed: Python 3.11 or newer (set PYTHON=...)" >&2
    exit 2
}
if [ ! -x .venv/bin/pip ]; then
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        root=''
        [ "$(id -u)" = 0 ] || root=sudo
        echo "install.sh: Python has no venv module; installing Debian's python3-venv" >&2
        $root apt-get update -qq
        $root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq python3-venv
    fi
    "$python" -m venv .venv
fi
case $extra in
    test) .venv/bin/pip install --quiet --editable '.[test]' ;;
    plot | tui | view | mcap | parquet | cluster | zenoh | bench) .venv/bin/pip install --quiet ".[$extra]" ;;
esac
