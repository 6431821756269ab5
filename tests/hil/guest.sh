#!/bin/bash
# guest.sh - run a command in a throw-away User-Mode Linux guest with SocketCAN, on this machine's files.
#
#   guest.sh [--systemd] COMMAND [ARGUMENT ...]   exit: the command's; 124 too late; 125 the guest was lost
#
# With --systemd that is the guest's first process, and the command runs beside it.
#
# The guest sees this machine's files read-only under a layer in memory: what the command writes is gone
# when it ends, but for its output and what it puts into $HIL_OUT. This keeps the machine clean; it is no
# security boundary. HIL_LIMIT_S (300) bounds the run, HIL_MEMORY (1500M) the guest's memory, a sparse
# file in /dev/shm; HIL_CPU is the number of the processor that it runs on, else the last one.
set -uo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
limit_s=${HIL_LIMIT_S:-300}
mode=plain
[ "${1:-}" != --systemd ] || { mode=systemd; shift; }
out=${HIL_OUT:-$(mktemp -d "${TMPDIR:-/tmp}/hil.XXXXXX")}
mkdir -p "$out"
case "$here$out$PWD" in *' '*) echo "guest.sh: paths travel on a kernel's command line: no spaces, please" >&2; exit 2;; esac
rm -f "$out/exit-code" "$out/console"

{   # What crosses into the guest: the folder, the variables that the tests read, the command.
    printf 'cd %q\n' "$PWD"
    for name in PATH OMP_NUM_THREADS NUMBA_CACHE_DIR ${!DAQSVC_@}; do
        [ -n "${!name:-}" ] && printf 'export %s=%q\n' "$name" "${!name}"
    done
    printf 'export DAQSVC_HIL_GUEST=1 HIL_OUT=%q\nexec' "$out"
    printf ' %q' "$@"
    echo
} >"$out/command"

# The guest has one processor and changes between host processes at every system call: on one processor
# of the host that takes a quarter of the time. In a process namespace of their own all of them end with
# the first, however it ends.
cpu=${HIL_CPU:-$(taskset -pc $$ | sed 's/.*[^0-9]//')}
sockets=$(mktemp -d "${TMPDIR:-/tmp}/uml.XXXXXX")
# See whole_registers.c: without it no guest starts on a processor with AMX.
preload=()
if grep -qw amx_tile /proc/cpuinfo; then
    gcc -shared -fPIC -O2 -o "$sockets/whole_registers.so" "$here/whole_registers.c"
    preload=(env LD_PRELOAD="$sockets/whole_registers.so")
fi
unshare --pid --fork --kill-child -- taskset -c "$cpu" "${preload[@]}" linux.uml \
    mem="${HIL_MEMORY:-1500M}" umid=hil uml_dir="$sockets" con=null con0=null,fd:1 ssl=null panic=-1 loglevel=4 \
    root=/dev/root rootfstype=hostfs rootflags=/ ro init="$here/guest-init.sh" \
    HIL_GUEST=1 HIL_MODE=$mode HIL_LIB="$here" HIL_OUT="$out" HIL_MODULES=/usr/lib/uml/modules </dev/null >"$out/kernel.log" 2>&1 &
guest=$!
trap 'kill -KILL $guest 2>/dev/null; rm -rf "$sockets"' EXIT
trap 'exit 130' INT TERM
touch "$out/console"
tail -n +1 -f --pid=$guest "$out/console" &
tail_pid=$!
late=
for ((tenths = 0; tenths < 10 * limit_s; tenths++)); do kill -0 $guest 2>/dev/null || break; sleep 0.1; done
kill -0 $guest 2>/dev/null && { late=1; kill -KILL $guest; }
wait $guest 2>/dev/null
wait $tail_pid 2>/dev/null

if [ -s "$out/exit-code" ]; then
    code=$(cat "$out/exit-code")
else
    code=125
    [ -n "$late" ] && code=124
    echo "guest.sh: the guest ${late:+took more than $limit_s s and }did not finish; the end of $out/kernel.log:" >&2
    tail -20 "$out/kernel.log" >&2
fi
[ -n "${HIL_OUT:-}" ] || [ "$code" != 0 ] || rm -rf "$out"
exit "$code"
