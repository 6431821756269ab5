"""The service, its store and its files."""

from daqsvc.errors.code import Code

NEEDS_RESTART = Code(
    "S01",
    "The change needs a restart",
    "daqsvc reload takes over most changes of a machine file while the service runs. Names, topics and "
    "the store change only when it starts.",
    "Restart the service, or undo the change: systemctl restart daqsvc.",
    "commands.md",
    example='machine.toml:14: site = "plant": the service runs with "lab", and changes that only when it '
    "starts. Remedy: restart the service for that, or take it back",
)
UNUSABLE_STORE = Code(
    "S02",
    "The store cannot be used",
    "Its path is no directory, this user may not write there, or a newer version of daqsvc has written it. "
    "Or it is that of another machine file with the same site, box and machine name: then status and alarms "
    "show that one, and nothing is done to its alarms.",
    "Correct store.directory, give the user of the service the right to write there, install the newer"
    " version, or give the machine another name.",
    "outbox.md",
    example="the store /var/lib/daqsvc/lab is that of pump.toml: fan.toml has the same site 'lab', box "
    "'edge-1' and machine 'pump', and would close its alarms. Remedy: write another name = ... in "
    "[machine] of fan.toml. If fan.toml takes the place of pump.toml, delete pump.toml, or name the "
    "store: daqsvc run fan.toml --store /var/lib/daqsvc/lab",
)
STORE_IN_USE = Code(
    "S03",
    "Another service uses the store",
    "One service at a time may write the alarm journal of a store, and one runs there already.",
    "Stop the other service, or give this one a separate store.",
    "outbox.md",
    "another daqsvc uses the store /var/lib/daqsvc; stop it if it watches the same machine, else give "
    "this one its own directory, e.g. /var/lib/daqsvc/NAME, in [store] of its machine file",
)
JOURNAL = Code(
    "S04",
    "The alarm journal cannot be used",
    "It is not there yet, is empty, this user may not read it, or the disk answers with errors.",
    "Start the service on the store once, ask with sudo, or check the disk.",
    "outbox.md",
    "daqsvc alarms: there is no journal /var/lib/daqsvc/lab/outbox.sqlite: the service has not run with "
    "this "
    "store yet",
)
ESSENTIAL_LOST = Code(
    "S05",
    "The service has lost what it cannot do without",
    "A part without which no alarm would be kept or sent has ended and does not start again.",
    "systemd starts the service again. Report it with the lines of the log before.",
    "commands.md",
    "the writer of the journal has failed; the service ends, and must be started again",
)
JOURNAL_BEHIND = Code(
    "S06",
    "The journal does not show the latest",
    "Events wait in the memory of the service for a disk that cannot be written. They are lost if it ends.",
    "Check the disk: make room, or mount it writable. The service writes them as soon as it can.",
    "outbox.md",
    "daqsvc alarms: 2 events wait in the service's memory for a disk that cannot be written: this "
    "is not their present state",
)
JOURNAL_DAMAGED = Code(
    "S07",
    "Messages of the journal have changed on the disk",
    "Their checksums do not fit: the disk has returned other bytes than were written.",
    "Replace the disk. What is damaged is left out, and everything else is used.",
    "outbox.md",
    "/var/lib/daqsvc/lab: 3 messages of the journal have changed on the disk and are left out",
)
DISK_REFUSES = Code(
    "S08",
    "The disk does not take what the service keeps",
    "It is full, mounted read-only, or answers with errors. Alarms go out, and wait in memory until it "
    "can be "
    "written.",
    "Make room, or mount it writable, before the service ends. Replace a disk that answers with errors.",
    "outbox.md",
    "outbox /var/lib/daqsvc/outbox.sqlite cannot be written: database or disk is full",
)
PART_FAILED = Code(
    "S09",
    "A part of the service has failed",
    "A mistake in the program or in a plugin, or a library that failed. The part is started again, and all "
    "others go on.",
    "Update the plugin that the message names. If it happens again, report it with the lines of the log "
    "before.",
    "status.md",
    "detector levels: failed with RuntimeError: boom at levels.py:315; it goes on with the next window",
)
PART_STALLED = Code(
    "S10",
    "A part of the service hangs",
    "It has made no step for some time: a disk, an adapter or a plugin does not return.",
    "Look at what the message names. systemd starts the service again if that lasts.",
    "status.md",
    "outbox has stalled, without a step for 60 s: the service manager gets no more signs of life, and "
    "starts the service again",
)
TOO_SLOW = Code(
    "S11",
    "This computer does not keep up",
    "It was suspended, has other work, or more comes than it can compute. Samples may be lost.",
    "Take other work off the computer, lower rates, or use a faster one.",
    "status.md",
    "the process did not run for 3.2 s (suspended, or starved by the host); samples that no buffer could "
    "hold "
    "meanwhile are counted as lost",
)
CONTROL_SOCKET = Code(
    "S12",
    "The control socket cannot be used",
    "It, or the link to it, was removed, or cannot be made in the store. daqsvc status and ack need it.",
    "Give the service a store on a file system that supports sockets, and take nothing out of it.",
    "commands.md",
    "no commands on this box until this is corrected: /var/lib/daqsvc/control.sock is "
    "not a socket, and no control socket can be made there; move it to another place",
)
NOT_REMEMBERED = Code(
    "S13",
    "The service may not know what was before",
    "The disk has lost or not taken what the last run wrote, so that states of alarms are sent again, or "
    "the "
    "ids of commands are not known.",
    "Look at the alarms once: daqsvc alarms. Check the disk if it happens again.",
    "outbox.md",
    "an earlier run has sent the broker what the disk never got, so the state of every alarm is sent again",
)
KERNELS = Code(
    "S14",
    "Compiled code is not kept",
    "The cache of compiled code cannot be written or used, so that each start takes longer and more memory.",
    "Give the service a cache directory that it may write in: $NUMBA_CACHE_DIR, or CacheDirectory= of "
    "systemd.",
    "install.md",
    "compiled kernels cannot be kept, and the next start compiles them again: Permission denied",
)
SNAPSHOT_LOST = Code(
    "S15",
    "A snapshot is not written",
    "The disk is full or cannot be written, or too many snapshots come at once.",
    "Make room in recorder.directory, or name another one.",
    "recorder.md",
    "a snapshot of pump is lost: No space left on device",
)
RELOAD_REFUSED = Code(
    "S16",
    "The changed machine files are not taken over",
    "They have errors, or the change needs a restart. The service goes on as it was.",
    "Correct the files: daqsvc check names each error. Then ask again, or restart the service.",
    "commands.md",
    "SIGHUP is refused, and the service goes on as before: site of pump.toml is "
    "different: restart the service",
)
WATCHDOG = Code(
    "S17",
    "WatchdogSec= of the unit does not fit",
    "It is no number, or shorter than parts of the service may take for one step.",
    "Write the time that the message names into the unit file.",
    "install.md",
    "WatchdogSec= is 1 s, and the limit of parts is 5 s: write at least that",
)
STOPPED_HARD = Code(
    "S18",
    "Something did not end in time",
    "While the service stopped, a part or a thread did not end, and was left behind or ended by force.",
    "Nothing, if it happens once: what is on disk is kept. Else look at what the message names.",
    "commands.md",
    "threads reader can0 do not end; the process is ended",
)
