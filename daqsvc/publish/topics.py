"""The topic tree: where each kind of message goes."""

from __future__ import annotations

import re
from dataclasses import dataclass

ANSWER = "response"
"""The answer to a command goes to its topic with this below."""

COMMANDS = "commands"

_NAME = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")


@dataclass(frozen=True, slots=True)
class CommandTopic:
    """What a topic below the commands of a box says.

    Attributes:
        machine: the machine that is meant, in one part.
        verb: what is asked; with ``/`` in it if something stands below a verb.
        is_answer: whether it is where an answer goes, of whichever client.
    """

    machine: str
    verb: str
    is_answer: bool


@dataclass(frozen=True, slots=True)
class Topics:
    """The topics of one box: everything lies below ``<root>/<site>/<box>``.

    Raises:
        ValueError: a name that is not safe in a topic.
    """

    root: str
    site: str
    box: str

    def __post_init__(self) -> None:
        for name in (self.root, self.site, self.box):
            _safe(name)

    @property
    def base(self) -> str:
        """What all topics of the box begin with."""
        return f"{self.root}/{self.site}/{self.box}"

    @property
    def availability(self) -> str:
        """Online or offline; retained, and the last will."""
        return f"{self.base}/availability"

    @property
    def status(self) -> str:
        """Figures of the service itself."""
        return f"{self.base}/status"

    def alarm(self, machine: str, alarm: str) -> str:
        """Every event of one alarm, in order; the latest is retained."""
        return f"{self.alarm_prefix(machine)}{_safe(alarm)}"

    def alarm_prefix(self, machine: str) -> str:
        """What the topics of all alarms of a machine begin with."""
        return f"{self.base}/{_safe(machine)}/alarms/"

    def diagnosis(self, machine: str, detector: str) -> str:
        """Every diagnosis of one detector."""
        return f"{self.base}/{_safe(machine)}/diagnosis/{_safe(detector)}"

    def readings(self, machine: str, detector: str) -> str:
        """Rounded figures of one detector, now and then, for people to look at."""
        return f"{self.base}/{_safe(machine)}/readings/{_safe(detector)}"

    def summary(self, machine: str) -> str:
        """How all alarms of a machine stand; retained."""
        return f"{self.base}/{_safe(machine)}/summary"

    @property
    def commands(self) -> str:
        """Filter for the commands to every machine of the box."""
        return f"{self.base}/+/{COMMANDS}/+"

    @property
    def below_commands(self) -> str:
        """Filter for what goes below a verb by mistake; answers lie there, too."""
        return f"{self.base}/+/{COMMANDS}/+/+/#"

    def command_of(self, topic: str) -> CommandTopic | None:
        """What a topic says that `commands` or `below_commands` matches; None for every other one.

        The one place where a topic from outside is taken apart.
        """
        below = f"{self.base}/"
        machine, *rest = topic.removeprefix(below).split("/")
        if not topic.startswith(below) or len(rest) < 2 or rest[0] != COMMANDS:
            return None
        verb = rest[1:]
        is_answer = any(part.startswith(ANSWER) for part in verb[1:])
        return CommandTopic(machine, "/".join(verb), is_answer=is_answer)

    def command(self, machine: str, verb: str) -> str:
        """Where a command to a machine is expected."""
        return f"{self.base}/{_safe(machine)}/{COMMANDS}/{_safe(verb)}"


def _safe(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{name!r} cannot stand in an MQTT topic; use letters, digits, '_', '.', '-', "
            f"and '/' between parts"
        )
    return name
