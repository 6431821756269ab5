"""The page of what a process of daqsvc gives and takes besides: exit codes, signals, environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from daqsvc import kernel_cache
from daqsvc.commands import arguments, early_signals
from daqsvc.commands.service_manager import VARIABLES
from daqsvc.publish.mqtt.credentials import CREDENTIALS_DIRECTORY
from daqsvc.reference.markdown import code, page, table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


class ExitCode(NamedTuple):
    """What an exit code states.

    Attributes:
        name: of the constant in `daqsvc.commands`.
        verbs: which verbs end so.
        about: when.
        remedy: what to do.
    """

    name: str
    verbs: str
    about: str
    remedy: str


EXIT_CODES = (
    ExitCode("EXIT_OK", "all", "it was done, or stopped as somebody asked", ""),
    ExitCode(
        "EXIT_FAILED",
        "all",
        "it could not be done: a bus that must be there is absent, no service runs, a command was refused, "
        "a file cannot be written, or somebody interrupted it",
        "stderr, or the log, states in one sentence what and why",
    ),
    ExitCode(
        "EXIT_USAGE",
        "all",
        "the command line is wrong, the machine file cannot be used, or nobody may use the store",
        "correct what the message names: to start it again changes nothing",
    ),
    ExitCode(
        "EXIT_REFUSED",
        "`analyze`, `calibrate`, `export`, `replay`",
        "a recording cannot be judged, or read",
        "the message states what is wrong with the recording",
    ),
    ExitCode(
        "EXIT_LOST",
        "`run`",
        "something without which the service is useless was lost, such as the writer of the journal",
        "start it again; the log states what was lost",
    ),
    ExitCode(
        "EXIT_HUNG",
        "`run`",
        "something hung while the service stopped, and it was ended by force",
        "start it again; the log states what hung",
    ),
    ExitCode(
        "EXIT_STUCK",
        "`run`",
        "the event loop was blocked for 30 s, and the service was ended by force",
        "start it again; the log states where it was blocked",
    ),
    ExitCode(
        "EXIT_INTERRUPTED",
        "all",
        "SIGINT came while the program was still being loaded, in its first second: nothing was open yet",
        "",
    ),
)
SIGNALS: Mapping[str, str] = {
    "SIGTERM": "ends the service, or a verb that runs until it is stopped, in good order within two seconds",
    "SIGINT": "the same: Ctrl-C",
    "SIGHUP": "has the service read its machine files again ([edge-box.md](../edge-box.md#reload)); where "
    "its terminal is gone it ends the service, unless it was started with `nohup`",
    "SIGUSR1": "is ignored, with a line in the log",
    "SIGUSR2": "is ignored, with a line in the log",
}
_NOTIFY, _WATCHDOG_US, _WATCHDOG_PID = VARIABLES
ENVIRONMENT: Mapping[str, str] = {
    "STATE_DIRECTORY": "directory of the store where the machine file and `--store` name none; systemd sets "
    "it by `StateDirectory=`",
    "XDG_STATE_HOME": "where the store of a user's service is, below `daqsvc`; `~/.local/state` if absent",
    "RUNTIME_DIRECTORY": "directory of the control socket, else it is in the store; systemd sets it by "
    "`RuntimeDirectory=`",
    kernel_cache.VARIABLE: "where compiled kernels are kept; it comes before the two below",
    "CACHE_DIRECTORY": "where compiled kernels are kept; systemd sets it by `CacheDirectory=`",
    "XDG_CACHE_HOME": "where kernels of a user are kept, below `daqsvc/kernels`; `~/.cache` if absent",
    CREDENTIALS_DIRECTORY: "where `password_credential` and `key_credential` are looked for; systemd sets it "
    "by `LoadCredential=`",
    _NOTIFY: "socket on which the service reports to systemd that it is ready, its state, and that it stops",
    _WATCHDOG_US: "how often systemd expects a sign of life, in us; systemd sets it by `WatchdogSec=`",
    _WATCHDOG_PID: "process that these signs are expected of; systemd sets it",
    "JOURNAL_STREAM": "set if the log goes to systemd's journal, which has the times; systemd sets it",
    "SUDO_USER": "who handled an alarm, if root does so by `sudo`: this name is in the audit log",
    "TERM": "with `dumb`, `daqsvc status --watch` prints one status after another instead of drawing "
    "over the last one",
}


def codes() -> dict[str, int]:
    """Every exit code that the program has a name for."""
    return {
        name: int(value)
        for module in (arguments, early_signals)
        for name, value in vars(module).items()
        if name.startswith("EXIT_")
    }


def gaps() -> Iterator[str]:
    """Exit codes that nothing describes."""
    known = {one.name for one in EXIT_CODES}
    for name in codes():
        if name not in known:
            yield f"exit code {name} is described nowhere: daqsvc.reference.process"


def _anchor(name: str) -> str:
    return name.lower().replace("_", "-")


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    numbers = codes()
    rows = [
        (
            f'<a id="{_anchor(one.name)}"></a>{code(f"{numbers[one.name]}")}',
            one.verbs,
            one.about,
            one.remedy,
        )
        for one in EXIT_CODES
    ]
    return {
        "process.md": page(
            "Exit codes, signals, environment",
            _ABOUT,
            "## Exit codes",
            table(("code", "of", "when", "what to do"), rows),
            "In a shell, a program that a signal ends has 128 and the number of the signal: 143 by SIGTERM.",
            "## Signals",
            table(("signal", "what it does"), ((code(name), text) for name, text in SIGNALS.items())),
            "## Environment variables",
            table(("variable", "what it sets"), ((code(name), text) for name, text in ENVIRONMENT.items())),
        )
    }


_ABOUT = """What a process of `daqsvc` gives to whoever starts it, and what it takes from there. An exit code
is also called an exit status. How the service ends, and what should start it again:
[architecture.md](../architecture.md#how-the-process-ends)."""
