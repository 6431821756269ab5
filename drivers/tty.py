"""Opening serial ports: why one cannot be opened, and what those cannot carry that have no UART."""

from __future__ import annotations

import errno
import grp
import logging
import os
import stat
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from daqsvc.errors.buses import LINE_SETTINGS
from daqsvc.errors.code import coded

if TYPE_CHECKING:
    from pathlib import Path

logger = logging.getLogger(__name__)

Parity: TypeAlias = Literal["none", "even", "odd"]

PSEUDO_TERMINAL_MAJORS = range(136, 144)
"""Major numbers of pseudo-terminals (Linux, Documentation/admin-guide/devices.txt: Unix98 PTY slaves)."""


class Character(NamedTuple):
    """How a character travels.

    Attributes:
        data_bits: 5 to 8.
        parity: of these bits.
    """

    data_bits: int
    parity: Parity


class CharacterFormat:
    """The characters of a serial line, and those that its port can carry.

    A pseudo-terminal passes bytes: the kernel drops parity and makes all characters 8 bits long, and the C
    library then fails with EINVAL. So that the virtual line works with the machine file of the real one, a
    port that turns out to be a pseudo-terminal is opened without parity, with 8 bits.

    Args:
        link: what a person calls the line.
        asked: characters of the device's line.
    """

    def __init__(self, link: str, asked: Character) -> None:
        self._link = link
        self._asked = asked
        self._is_logged = False

    def on(self, port: str | Path) -> Character:
        """The characters with which to open a port; what is left out is logged once, as a warning.

        Args:
            port: path of its device, which may be a link to it, and need not be there.
        """
        if not is_pseudo_terminal(port):
            return self._asked
        carried = Character(8, "none")
        if carried != self._asked and not self._is_logged:
            self._is_logged = True
            logger.warning(
                "%s is a pseudo-terminal, which passes whole bytes only: it is opened without parity and "
                "with 8 data bits, instead of parity %r and %d data bits; correct the port if a real device "
                "is meant",
                self._link,
                self._asked.parity,
                self._asked.data_bits,
                extra=coded(LINE_SETTINGS),
            )
        return carried


def is_pseudo_terminal(port: str | Path) -> bool:
    """Whether a path leads to a pseudo-terminal; False if there is nothing."""
    try:
        status = os.stat(port)  # noqa: PTH116 - a path or an URL, as pyserial takes it
    except (OSError, ValueError):  # whoever opens it states what is wrong with it
        return False
    return stat.S_ISCHR(status.st_mode) and os.major(status.st_rdev) in PSEUDO_TERMINAL_MAJORS


def why_not_open(error: Exception, port: str, key: str) -> str:
    """Why a serial port cannot be opened, and what to do.

    Args:
        error: what opening it raised.
        port: path of its device.
        key: what the machine file calls it.
    """
    number = getattr(error, "errno", None)
    if "exclusively lock" in f"{error}" or number in {errno.EBUSY, errno.EAGAIN}:
        return "another program has it open; stop that program"
    if number == errno.ENOENT:
        return f"there is no {port}; plug the device in, or correct {key}"
    if number == errno.EACCES:
        return f"permission denied; {_remedy_of_owner(port)}"
    if number == errno.EPERM:
        return "not permitted: a sandbox keeps it away; allow it by DeviceAllow= in a drop-in of the unit"
    # pyserial has the number of this one in its text only.
    no_terminal = os.strerror(errno.ENOTTY) in f"{error}"
    if kind := _other_kind(port) or "another device" * no_terminal:
        return f"{port} is no serial port ({kind}); plug the device in, or correct {key}"
    return f"{error}" or type(error).__name__


def _other_kind(port: str) -> str:
    """What is at a path where no device can be; empty if it may be one."""
    try:
        mode = os.stat(port).st_mode  # noqa: PTH116 - as above
    except (OSError, ValueError):
        return ""
    return "a file" if stat.S_ISREG(mode) else "a directory" if stat.S_ISDIR(mode) else ""


def _remedy_of_owner(port: str) -> str:
    """What lets the service open a port that belongs to somebody else."""
    member = "make the service's user a member of the group {}"
    try:
        status = os.stat(port)  # noqa: PTH116 - as above
    except OSError:
        return member.format("dialout")
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = f"{status.st_gid}"
    if status.st_mode & stat.S_IRGRP and status.st_mode & stat.S_IWGRP:
        return member.format(group)
    mode = stat.S_IMODE(status.st_mode)
    return (
        f"its owner alone may open it (mode {mode:04o}, group {group}): give it to dialout with mode 0660 by "
        f"a rule of udev, and {member.format('dialout')}"
    )
