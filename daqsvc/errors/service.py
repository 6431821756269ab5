"""The service, its store and its files."""

from daqsvc.errors.code import Code

NEEDS_RESTART = Code(
    "S01",
    "The change needs a restart",
    "daqsvc reload takes over most changes of a machine file while the service runs. Names, topics and "
    "the store change only when it starts.",
    "Restart the service, or undo the change: systemctl restart daqsvc.",
    "commands.md",
)
UNUSABLE_STORE = Code(
    "S02",
    "The store cannot be used",
    "Its path is no directory, this user may not write there, a newer version of daqsvc has written it, or "
    "it is that of another machine file with the same site, box and machine name.",
    "Correct store.directory, give the user of the service the right to write there, install the newer"
    " version, or give the machine another name.",
    "outbox.md",
)
