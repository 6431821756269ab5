#!/bin/bash
# run.sh - tests/hil, and the conformance suite over SocketCAN, on real vcan interfaces (root).
#
# Natively where the kernel has vcan, in a network namespace of its own; otherwise in a guest kernel
# (guest.sh). Then the Debian package and the unit, each under a systemd of its own, always in a guest. Whatever is
# missing for either is a failure, never a reason to skip.
#
#   run.sh [ARGUMENT OF PYTEST ...]      HIL_GUEST=1 forces the guest; arguments leave the unit out
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cd "$here/../.."

missing() { echo "hil: $1 is missing; install it with: apt-get install --no-install-recommends user-mode-linux kmod iproute2 can-utils mosquitto systemd debhelper gcc libc6-dev" >&2; exit 1; }
[ "$(id -u)" = 0 ] || { echo "hil: interfaces are made by root only; run it as root" >&2; exit 1; }
for program in ip cansend candump cangen; do command -v "$program" >/dev/null || missing "$program"; done
command -v mosquitto >/dev/null || [ -x /usr/sbin/mosquitto ] || missing mosquitto

export PATH="$PWD/.venv/bin:$PATH:/usr/sbin" DAQSVC_HIL=1 DAQSVC_REQUIRE_MOSQUITTO=1 OMP_NUM_THREADS=1
export NUMBA_CACHE_DIR=${NUMBA_CACHE_DIR:-$PWD/.cache/kernels}
unit=(python -m pytest -q -p no:cacheprovider)
suite=(python -m pytest -q -p no:cacheprovider tests/hil tests/conformance -k vcan "$@")

command -v linux.uml >/dev/null || missing linux.uml
command -v modprobe >/dev/null || missing kmod
[ -x /lib/systemd/systemd ] || missing systemd
command -v dh >/dev/null || missing dh
! grep -qw amx_tile /proc/cpuinfo || command -v gcc >/dev/null || missing gcc
status=0
package=
told=$(mktemp)
trap '[ -z "$package" ] || kill "$package" 2>/dev/null; rm -f "$told"' EXIT
if [ "$#" = 0 ]; then
    DAQSVC_DEBS=$(PYTHONPATH=tests python -m support.deb_package)
    DAQSVC_HOST_S=$(PYTHONPATH=tests python -m support.unit_kernels)
    export DAQSVC_DEBS DAQSVC_HOST_S HIL_LIMIT_S=${HIL_LIMIT_S:-600}
    # Never on this machine itself: the unit is installed, killed and hung. An upgrade has both versions on the disk,
    # which is in memory; what is installed then is gone with the guest, so the unit has another one.
    # The package needs no clock to be true, so its guest runs beside the tests of the bus, on the first processor;
    # the unit is held to seconds, and runs alone.
    echo "hil: the package under systemd, in a guest, beside what follows"
    first=$(taskset -pc $$ | sed 's/.*: *//; s/[^0-9].*//')
    HIL_CPU=$first HIL_MEMORY=${HIL_MEMORY:-2500M} "$here/guest.sh" --systemd "${unit[@]}" tests/hil/test_package.py >"$told" 2>&1 &
    package=$!
fi
has_vcan() { unshare --net ip link add dev probe type vcan 2>/dev/null; }
if [ -z "${HIL_GUEST:-}" ] && { has_vcan || { modprobe -a can-raw vcan 2>/dev/null && has_vcan; }; }; then
    echo "hil: vcan of this kernel ($(uname -r)), in a network namespace of its own"
    unshare --net -- sh -c 'ip link set lo up; exec "$@"' sh "${suite[@]}" || status=$?
else
    echo "hil: this kernel ($(uname -r)) has no vcan; booting a guest"
    "$here/guest.sh" "${suite[@]}" || status=$?
fi
if [ "$#" = 0 ]; then
    wait "$package" || status=$?
    package=
    cat "$told"
    echo "hil: the unit under systemd, in a guest"
    HIL_MEMORY=${HIL_MEMORY:-2500M} "$here/guest.sh" --systemd "${unit[@]}" tests/hil/test_systemd.py || status=$?
fi
exit "$status"
