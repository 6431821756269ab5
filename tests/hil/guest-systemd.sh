# guest-systemd.sh - sourced by guest-init.sh before it becomes systemd: the least that makes a manager and a
# journal, and a unit that runs the command. It writes into the guest's layer in memory only.
S=/etc/systemd/system
# As systemd itself does where it does not take the host's files for those of a container: without it credentials,
# which are mounted in a namespace of their own, come to no unit.
mount --make-rshared /
rm -rf $S/*.wants $S/*.requires    # what is enabled on the host
: >/etc/fstab
[ -s /etc/machine-id ] || systemd-machine-id-setup >/dev/null 2>&1
for unit in systemd-timesyncd systemd-random-seed systemd-pstore systemd-binfmt systemd-hwdb-update \
    systemd-journal-catalog-update systemd-update-done systemd-sysusers systemd-udevd systemd-udev-trigger \
    systemd-modules-load systemd-firstboot systemd-machine-id-commit systemd-boot-system-token systemd-remount-fs \
    systemd-update-utmp modprobe@ kmod-static-nodes systemd-journal-flush systemd-tmpfiles-setup-dev; do
    ln -sf /dev/null "$S/$unit.service"
done
for unit in dev-hugepages.mount sys-kernel-debug.mount sys-kernel-tracing.mount sys-kernel-config.mount \
    sys-fs-fuse-connections.mount dev-mqueue.mount proc-sys-fs-binfmt_misc.automount tmp.mount swap.target \
    systemd-tmpfiles-clean.timer systemd-ask-password-console.path systemd-ask-password-wall.path; do
    ln -sf /dev/null "$S/$unit"
done
# It empties /tmp, where the command may lie.
mkdir -p /etc/tmpfiles.d && ln -sf /dev/null /etc/tmpfiles.d/tmp.conf
mkdir -p /etc/systemd/journald.conf.d
printf '[Journal]\nStorage=volatile\nRateLimitIntervalSec=0\nForwardToConsole=no\n' >/etc/systemd/journald.conf.d/hil.conf
cat >$S/hil.service <<U
[Unit]
Description=the command of the guest
After=basic.target
[Service]
Type=exec
Environment=HOME=/root TERM=dumb LANG=C.UTF-8 DAQSVC_HIL_SYSTEMD=1
StandardInput=null
ExecStart=/bin/sh -c 'sh $HIL_OUT/command >>$HIL_OUT/console 2>&1; echo \$\$? >$HIL_OUT/exit-code.new; mv $HIL_OUT/exit-code.new $HIL_OUT/exit-code'
ExecStopPost=-/usr/bin/systemctl poweroff --force --force
U
cat >$S/hil.target <<U
[Unit]
Requires=basic.target hil.service
After=basic.target
AllowIsolate=yes
U
ln -sf $S/hil.target $S/default.target
