"""The topic tree: where each kind of message goes."""

from __future__ import annotations

import re
from dataclasses import dataclass

ANSWER = "response"
"""The answer to a command goes to its topic with this below."""

_NAME = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")


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

    def summary(self, machine: str) -> str:
        """How all alarms of a machine stand; retained."""
        return f"{self.base}/{_safe(machine)}/summary"

    @property
    def commands(self) -> str:
        """Filter for the commands to every machine of the box."""
        return f"{self.base}/+/commands/+"

    @property
    def below_commands(self) -> str:
        """Filter for what goes below a verb by mistake; answers lie there, too."""
        return f"{self.base}/+/commands/+/+/#"

    def is_answer(self, topic: str) -> bool:
        """Whether a topic below a command is one of its answers, of whichever client."""
        _, _, *below = topic.removeprefix(f"{self.base}/").split("/")
        return any(part.startswith(ANSWER) for part in below[1:])

    def command(self, machine: str, verb: str) -> str:
        """Where a command to a machine is expected."""
        return f"{self.base}/{_safe(machine)}/commands/{_safe(verb)}"


def _safe(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{name!r} cannot stand in an MQTT topic; use letters, digits, '_', '.', '-', "
            f"and '/' between parts"
        )
    return name
