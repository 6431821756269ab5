#!/bin/sh
# guest-init.sh - the first process of the guest (see guest.sh). Its last act is to switch the machine off,
# so it refuses to be anything but that.
#
# The words HIL_* come from the kernel's command line: HIL_OUT is a folder of the host, writable at the same
# path; it holds `command` and receives `console` and `exit-code`. HIL_MODULES holds VERSION/modules.dep.
[ "$$" = 1 ] && [ "${HIL_GUEST:-}" = 1 ] || { echo "guest-init.sh is for a guest's first process only" >&2; exit 99; }
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
give_up() { echo "guest-init: $*"; poweroff -f -f; sleep 60; }

# A writable root that is thrown away: the host's, read-only, under a layer in memory.
mount -t proc proc /proc
mount -t tmpfs -o size=75% tmpfs /mnt
mkdir -p /mnt/modules/lib /mnt/upper /mnt/work /mnt/root
ln -s "$HIL_MODULES" /mnt/modules/lib/modules
modprobe -d /mnt/modules overlay || give_up "no module overlay in $HIL_MODULES"
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root || give_up "no overlay"
mkdir -p /mnt/root/.host
cd /mnt/root && pivot_root . .host && cd / || give_up "no new root"

mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts -o gid=5,mode=620,ptmxmode=666 devpts /dev/pts
mount -t tmpfs -o mode=1777 tmpfs /dev/shm
mount -t tmpfs -o mode=755 tmpfs /run
ln -sf /proc/self/fd /dev/fd
ln -sf /proc/self/fd/0 /dev/stdin
ln -sf /proc/self/fd/1 /dev/stdout
ln -sf /proc/self/fd/2 /dev/stderr
mkdir -p "$HIL_OUT"
mount -t hostfs none "$HIL_OUT" -o "$HIL_OUT" || give_up "cannot write to $HIL_OUT"

mkdir -p /lib/modules
mount --bind "$HIL_MODULES" /lib/modules
for module in can can-raw vcan; do modprobe "$module" || give_up "no module $module in $HIL_MODULES"; done
hostname hil-guest
# vcan drops silently above this queue, before any socket counts it (1000 by default).
echo 100000 >/proc/sys/net/core/netdev_max_backlog
ip link set lo up

if [ "${HIL_MODE:-}" = systemd ]; then
    . "$HIL_LIB/guest-systemd.sh"
    exec /lib/systemd/systemd --show-status=false --log-target=journal
fi
HOME=/root TERM=dumb LANG=C.UTF-8 sh "$HIL_OUT/command" </dev/null >"$HIL_OUT/console" 2>&1
echo $? >"$HIL_OUT/exit-code.new"
mv "$HIL_OUT/exit-code.new" "$HIL_OUT/exit-code"
poweroff -f -f
sleep 60
