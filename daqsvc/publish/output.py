"""What an output is given, and what it does: it tells others what the service finds.

Whatever an output does wrong, acquisition, diagnosis, alarms and the other outputs go on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from daqsvc.supervision import StallWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import CommandHandler, SnapshotHandler
    from daqsvc.alarms.conditions import Condition
    from daqsvc.diagnosis.reading import Reading
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.errors.code import Code
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.looking import Look
    from daqsvc.publish.topics import Topics
    from daqsvc.supervision import Progress


@dataclass(frozen=True, slots=True)
class Watched:
    """What there is to report about a machine, known before anything happens there.

    Attributes:
        machine: name of the machine.
        description: what a person should know about it.
        alarms: names of its alarms.
        services: alarms about sensors, detectors and the service, rather than the machine.
        readings: the figures to show.
        findings: the detectors whose decision is shown.
        rests_on: by alarm, the alarms about sensors and detectors that state whether it can be judged.
        buses: names of the buses that it is watched over.
        rates_hz: by the name that a stream has in the status, what its machine file states.
    """

    machine: str
    description: str = ""
    alarms: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    readings: tuple[Reading, ...] = ()
    findings: tuple[str, ...] = ()
    rests_on: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    buses: tuple[str, ...] = ()
    rates_hz: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class EarlierState:
    """A state of an earlier run, to be asked for once before this run takes its place.

    Attributes:
        topic: where it is retained, if it is.
        take: takes its payload.
        is_asked: whether the broker was asked.
        is_answered: whether it has answered.
    """

    topic: str
    take: Callable[[bytes], None]
    is_asked: bool = False
    is_answered: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputPort:
    """What an output works with.

    Attributes:
        machines: by name, what there is to report about each machine. The last one has what the service
            reports about itself as well; where there are several, it is the service alone, without readings.
        store: directory of what survives restarts.
        clock: the service's clock.
        outbox: the alarm events, on disk and numbered; an output goes on after the last one that it has sent
            by ``await outbox.next_following(sequence, most)``. Open while `Output.run` runs.
        topics: of the box, whose site and name they have; by them events are known in the outbox.
        commands: carries out what people ask of alarms; an output has to see that they may.
        snapshots: has snapshots of machines made for people; as above.
        look: begins a feed of live data of a machine; None if there is none.
        earlier: what a broker is asked for before anything is sent to it; None for nothing.
        progress: states how far each part of the service has come that can stall.
        stalls: finds those that have.
    """

    machines: Mapping[str, Watched]
    store: Path
    clock: Clock
    outbox: Outbox
    topics: Topics
    commands: CommandHandler | None = None
    snapshots: SnapshotHandler | None = None
    look: Look | None = None
    earlier: EarlierState | None = None
    progress: Callable[[], Mapping[str, Progress]] = dict
    stalls: StallWatch = field(default_factory=lambda: StallWatch(dict))


class Output:
    """Tells others what the service finds. Every method is called by the event loop and must not block it."""

    _reason = ""
    code: Code | None = None
    """Of the kind of `reason`; None where it is not stated."""
    _away_since_s: float | None = None

    @property
    def reason(self) -> str:
        """Why there is no connection at present, for people; empty if there is one or it is not known."""
        return self._reason

    @reason.setter
    def reason(self, reason: str) -> None:
        if not reason:
            self._away_since_s = self.code = None
        elif not self._reason:
            self._away_since_s = time.monotonic()
        self._reason = reason

    @property
    def away_s(self) -> float | None:
        """For how long there has been no connection, for any `reason`; None if there is one."""
        return None if self._away_since_s is None else time.monotonic() - self._away_since_s

    async def run(self) -> None:
        """Tell, until `stop` or until cancelled; begun again if it fails or ends before."""
        raise NotImplementedError

    async def stop(self, deadline_s: float) -> None:
        """Hand over what is left, and end `run`; what takes longer than the deadline is cancelled."""

    def report(self, diagnosis: Diagnosis) -> None:
        """Take in a statement of a detector; several a second."""

    def status(self, figures: Mapping[str, Any]) -> None:
        """Take in the figures of the service, by what they belong to; once a second."""

    def figures(self) -> dict[str, Any]:
        """What it has done, in numbers, or mappings of numbers, by name: part of the status."""
        return {}

    def conditions(self, raised: frozenset[str]) -> Iterable[Condition]:
        """Its state, as far as that is known; each is an alarm. Asked for once a second.

        Args:
            raised: names of conditions that were ever reported, also before a restart.
        """
        del raised
        return ()


def _nothing(_port: OutputPort) -> dict[str, Output]:
    return {}


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputSet:
    """The outputs of a machine file, to be made once there is an outbox.

    Attributes:
        machines: see `OutputPort.machines`.
        make: makes them, by the path of their table.
        topic_root: first part of the topics by which events are known in the outbox.
        conditions: names of all that they may report about themselves.
        outdated: see `OutputPlugin.outdated`, of those that the file has no table for.
    """

    machines: Mapping[str, Watched]
    make: Callable[[OutputPort], Mapping[str, Output]] = _nothing
    topic_root: str = "daqsvc"
    conditions: tuple[str, ...] = ()
    outdated: Mapping[str, str] = field(default_factory=dict)


def output_name(path: str) -> str:
    """What an output is called in the log and in the count of failures, by the path of its table."""
    return path.rpartition(".")[2]
