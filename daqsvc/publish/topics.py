"""The topic tree: where each kind of message goes."""

from __future__ import annotations

import re
from dataclasses import dataclass

ANSWER = "response"
"""The answer to a command goes to its topic with this below."""

COMMANDS = "commands"

LIVE = "live"
REQUEST = "request"
FEED = "feed"

_NAME = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")


@dataclass(frozen=True, slots=True)
class CommandTopic:
    """What a topic below the commands of a box states.

    Attributes:
        machine: the machine that is meant, in one part.
        verb: what is asked; with ``/`` in it if something is below a verb.
        is_answer: whether it is where an answer goes, of whichever client.
    """

    machine: str
    verb: str
    is_answer: bool


@dataclass(frozen=True, slots=True)
class LiveTopic:
    """What the topic of a request for live data names.

    Attributes:
        machine: the machine, in one part.
        looker: the viewer, by a name that it has chosen.
    """

    machine: str
    looker: str


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
        """What a topic states that `commands` or `below_commands` matches; None for every other one.

        The one place where a topic from outside is taken apart.
        """
        below = f"{self.base}/"
        machine, *rest = topic.removeprefix(below).split("/")
        if not topic.startswith(below) or len(rest) < 2 or rest[0] != COMMANDS:
            return None
        verb = rest[1:]
        is_answer = any(part.startswith(ANSWER) for part in verb[1:])
        return CommandTopic(machine, "/".join(verb), is_answer=is_answer)

    @property
    def live_requests(self) -> str:
        """Filter for the requests for live data of any machine of the box."""
        return f"{self.base}/+/{LIVE}/+/{REQUEST}"

    def live_request_of(self, topic: str) -> LiveTopic | None:
        """What a topic states that `live_requests` matches; None for every other one."""
        below = f"{self.base}/"
        parts = topic.removeprefix(below).split("/")
        if not topic.startswith(below) or len(parts) != 4 or (parts[1], parts[3]) != (LIVE, REQUEST):
            return None
        machine, looker = parts[0], parts[2]
        return LiveTopic(machine, looker) if _NAME.fullmatch(f"{machine}/{looker}") else None

    def live_request(self, machine: str, looker: str) -> str:
        """Where a request for live data is expected."""
        return f"{self.base}/{_safe(machine)}/{LIVE}/{_safe(looker)}/{REQUEST}"

    def live_feed(self, machine: str, looker: str) -> str:
        """Where the feed of a viewer goes."""
        return f"{self.base}/{_safe(machine)}/{LIVE}/{_safe(looker)}/{FEED}"

    def command(self, machine: str, verb: str) -> str:
        """Where a command to a machine is expected."""
        return f"{self.base}/{_safe(machine)}/{COMMANDS}/{_safe(verb)}"


@dataclass(frozen=True, slots=True)
class BoxTopic:
    """What the topic of a box reports to who listens to many.

    Attributes:
        site: of the box.
        box: its name.
        rest: what is below it, e.g. ``("laval-rig", "alarms", "rotor-fault")``; an alarm's or a
            detector's name in one part, whatever it holds.
    """

    site: str
    box: str
    rest: tuple[str, ...]


def box_topic(root: str, topic: str) -> BoxTopic | None:
    """What a topic below a root states; None if it is none of a box."""
    if not topic.startswith(f"{root}/"):
        return None
    site, box, *rest = [*topic.removeprefix(f"{root}/").split("/", 4), "", ""][:5]
    parts = tuple(part for part in rest if part)
    if not parts or not _NAME.fullmatch(f"{site}/{box}/{parts[0]}"):
        return None
    return BoxTopic(site, box, parts)


def is_one_part(name: str) -> bool:
    """Whether a name can be used in a topic, as one part of it."""
    return "/" not in name and _NAME.fullmatch(name) is not None


def _safe(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{name!r} cannot be in an MQTT topic; use letters, digits, '_', '.', '-', and '/' between parts"
        )
    return name
