"""The command line."""

from daqsvc.errors.code import Code

_PAGE = "commands.md"

ARGUMENTS = Code(
    "C01",
    "The arguments do not go together",
    "One is missing or unknown, two exclude each other, or one has no use beside the others.",
    "Correct what the message names. daqsvc VERB --help lists the arguments.",
    "reference/verbs.md",
    "daqsvc trend: --since is not before --until; write the earlier one as --since",
)
WRONG_VALUE = Code(
    "C02",
    "An argument has a wrong value",
    "It is no number, time, address or name as the argument takes it, or it is out of its range.",
    "Write a value as the message asks for.",
    "reference/verbs.md",
    "daqsvc shelve: argument --for: '5 min' is not a time; write e.g. 90s, 30m, 8h, 2d or 1h30m; see daqsvc "
    "shelve --help",
)
NO_STORE = Code(
    "C03",
    "It is not known which store is meant",
    "The verb works on the alarm journal of a service. No file and no --store names it, and there is not "
    "exactly one at the usual place, or what was named is no directory.",
    "Name the machine file that the service runs, or its store with --store.",
    "outbox.md",
    "daqsvc alarms: there is no alarm journal below /home/ann/.local/state/daqsvc: name the machine "
    "file, or "
    "its store with --store",
)
NO_SUCH_MACHINE = Code(
    "C04",
    "There is no such machine",
    "The store, the history or the service has machines, but none of this name.",
    "Write one of the names that the message lists.",
    "several-machines.md",
    "daqsvc alarms: the store /var/lib/daqsvc/lab has alarms of pump, not of pmup",
)
NO_SUCH_ALARM = Code(
    "C05",
    "It is not known which alarm is meant",
    "No alarm has this name, several machines have one, what was written begins the ids of several, or no "
    "alarm that a pattern matches waits for the command.",
    "Write the name of the alarm, or more of its id; with several machines the machine, too. daqsvc alarms "
    "lists them.",
    "alarms.md",
    "daqsvc ack: '0c4f' begins the ids of housing, shaft: write more of the id, or the alarm's name",
)
NO_SERVICE = Code(
    "C06",
    "No service answers",
    "No service runs on the store, or it has just begun, or its control socket was removed.",
    "Start the service, or name the store of the one that runs: with the machine file, or with --store.",
    _PAGE,
    "daqsvc status: no daqsvc runs on the store /var/lib/daqsvc/lab: start it with daqsvc run, or name "
    "its store with --store; one that was started just now needs some seconds",
)
NOT_ASKED = Code(
    "C07",
    "The service cannot be asked that",
    "It takes commands from its own user and from root only, is of an older version, is too busy, or is "
    "about to stop. Or what was sent is no request that it knows.",
    "Try again with sudo, or as the user of the service. Restart a service that is older than this program. "
    "Programs write requests as the page shows.",
    _PAGE,
    "daqsvc status: the daqsvc of /var/lib/daqsvc/lab takes commands from its own user and from root only: "
    "try again with sudo",
)
COMMAND_REFUSED = Code(
    "C08",
    "The service has refused the command",
    "The state of the alarm does not allow it, or this person may not ask for it. No snapshot is made "
    "without [recorder].",
    "Do what the message asks for. daqsvc alarms shows the state of each alarm.",
    "alarms.md",
    "daqsvc reset: refused: cannot reset rotor-fault: its condition is still present; remove the cause, then "
    "reset",
)
CANNOT_WRITE = Code(
    "C09",
    "Nothing can be written there",
    "The folder is not there, this user may not write into it, or the disk is full.",
    "Make the folder, or name another one that this user may write into.",
    _PAGE,
    "daqsvc example: /etc/pump.toml cannot be written: Permission denied",
)
CANNOT_READ = Code(
    "C10",
    "A file that the verb needs cannot be read",
    "It is not there, this user may not read it, or what it holds is no file of this kind.",
    "Correct the path, or give this user the right to read the file.",
    _PAGE,
    "daqsvc trend: the history in /var/lib/daqsvc/lab cannot be read: file is not a database",
)
THERE_ALREADY = Code(
    "C11",
    "The file is there already",
    "No file is replaced unless the arguments ask for it.",
    "Give another name, or remove the file first. new, export and trend replace it with --overwrite.",
    _PAGE,
    "daqsvc example: pump.toml is there already; give another name",
)
EXTRA_MISSING = Code(
    "C12",
    "A package is missing",
    "What was asked for needs a package that comes with an extra of daqsvc only.",
    "Install the extra that the message names.",
    "install.md",
    "daqsvc analyze: --plot needs matplotlib; install it with: pip install 'daqsvc[plot]'",
)
NOTHING_RECORDED = Code(
    "C13",
    "The history has nothing of that",
    "The service keeps no history, has written nothing at that time, or has no figure of this name.",
    "Ask for another time or figure. A service writes a history if its machine file has [history].",
    "history.md",
    "daqsvc trend: there is no history in /var/lib/daqsvc/lab; write [history] into the machine file, and "
    "start the service with it; or if the service was started with --store, give the same --store in place "
    "of FILE",
)
NOT_KNOWN = Code(
    "C14",
    "There is nothing of this name",
    "The example, code or account that was named is not there.",
    "Write one of the names that the message lists. Without a name, the verb lists all.",
    _PAGE,
    "daqsvc explain: there is no code 'Z99'; daqsvc explain lists them",
)
INTERRUPTED = Code(
    "C15",
    "It was interrupted",
    "Ctrl-C, a signal, or the end of the input came before it was done.",
    "Start it again, and let it run to its end.",
    _PAGE,
    "daqsvc calibrate: interrupted; nothing was written",
)
OUTPUT_CUT = Code(
    "C16",
    "The output is not complete",
    "The disk is full, or the terminal or device that it went to is gone.",
    "Make room, or send the output elsewhere, and start it again.",
    _PAGE,
    "daqsvc: No space left on device: the output is not complete",
)
CANNOT_LISTEN = Code(
    "C17",
    "The page cannot listen at this address",
    "Another program listens there, this computer does not have the address, or this user may not use the "
    "port.",
    "Name another port with --port, or another address with --listen. For the page of a service, write "
    "another listen in [page] of the machine file.",
    "page.md",
    "daqsvc page: cannot listen at 127.0.0.1:8420: Address already in use; give another --port",
)
UNSAFE_PAGE = Code(
    "C18",
    "The page would not be safe there",
    "Beyond this box the page needs TLS and accounts, or a reverse proxy that names who asks.",
    "Add what the message names, or listen on 127.0.0.1 only.",
    "page.md",
    "daqsvc page: at 192.0.2.7 others than this box reach the page: give --certificate, --private-key and"
    " --accounts; or --user-header and --proxy, behind a reverse proxy; or listen at 127.0.0.1",
)
ACCOUNTS = Code(
    "C19",
    "The file of accounts cannot be used",
    "It is not there, others may read or change it, or a line of it is no account.",
    "Correct what the message names. daqsvc account writes the file.",
    "page.md",
    "daqsvc account: /etc/daqsvc/accounts may be read or written by others: chmod 600 /etc/daqsvc/accounts",
)
NOTHING_ON_BUS = Code(
    "C20",
    "Nothing of use was seen on the bus",
    "Nobody sends or answers. On a line, the bit rate or the parity is wrong, or the cable is not plugged "
    "in. On a network, the address, the port or the unit is wrong, or a firewall is between. Or a Modbus "
    "device answers, but has none of the registers that were asked for. Or CAN frames come, and nothing "
    "states what their bytes mean.",
    "Check power, cable and the settings that the message names, and look for longer. If the device answers, "
    "see its manual for the registers that it has, and ask for these, or for another unit. For CAN frames "
    "give the DBC file of the device, or answer what its manual states of them.",
    "sniff.md",
    "daqsvc: CAN bus 'can0' (socketcan can0) has carried no frame, so there is no plant.blf; its state at"
    " the end: up",
)
NOT_OPENED = Code(
    "C21",
    "The port or interface cannot be opened",
    "It is not there, another program has it, or this user may not use it.",
    "Correct its name, end the other program, or join the group that may use it.",
    "sniff.md",
    "daqsvc: /dev/ttyUSB9 cannot be opened: there is no /dev/ttyUSB9; plug the device in, or correct the "
    "name",
)
ANSWER = Code(
    "C22",
    "An answer cannot be used",
    "An answer that was given beforehand is missing or wrong.",
    "Correct the option or the file of answers that the message names.",
    "machine-file.md",
    "daqsvc new: --answers plant.toml: No such file or directory",
)
SIMULATION = Code(
    "C23",
    "The machine cannot be simulated",
    "The scenario is not there or has mistakes, or what it plays does not fit the machine file or the bus.",
    "Do what the message asks for.",
    "virtual-bus.md",
    "daqsvc sim: there is no scenario 'unbalnce': neither a file nor one of healthy, link-faults, paper",
)
ARCHIVE = Code(
    "C24",
    "The archive or its results cannot be used",
    "The place cannot be reached or read, has no machine, or another program writes the results.",
    "Correct the place that the message names, or wait for the other program.",
    "fleet.md",
    "daqsvc fleet: /srv/results holds no results; give the folder that daqsvc analyze --cluster wrote",
)
PROCESS_LOST = Code(
    "C25",
    "A process has ended in mid-work",
    "Another process that did part of the work has ended, mostly because the memory was full.",
    "Try again with fewer processes (--jobs), or on a box with more memory.",
    "analyze.md",
    "daqsvc analyze: a process was killed while run7.csv was waited for (out of memory?); give fewer --jobs",
)
LEFT_OUT = Code(
    "C26",
    "A verb or an addition to one is left out",
    "A package registers a verb, a kind of sniff, questions or codes that cannot be loaded, or codes with "
    "the letters of another package.",
    "Install the package again, update it, or remove it. Everything else works.",
    _PAGE,
    "daqsvc: verb 'twin' is left out: No module named 'twin'",
)
OTHER_FILES = Code(
    "C27",
    "The service reads other machine files",
    "The file that was named is not the one that the service was started with, or has errors meanwhile.",
    "Name the file or directory that the message names, or correct the file that has errors.",
    "several-machines.md",
    "daqsvc reload: the service was started with /etc/daqsvc/lab.toml: it reads that again, also if "
    "another one is named here",
)
