"""The alarm service: diagnoses in; alarms on disk and at the broker out.

Everything that must not be lost passes here and nowhere else: an event leaves the alarm manager, gets its
number and its place on disk from the outbox, and is published from there. What people ask for goes the same
way (`daqsvc.alarm_commands`). It knows nothing of buses, samples or detectors, so it can be tried by itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarm_commands import CommandExecutor
from daqsvc.alarm_log import AlarmLog
from daqsvc.alarms.commands import CommandOutcome
from daqsvc.alarms.conditions import Condition
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.audit import AuditLog
from daqsvc.errors.code import coded
from daqsvc.errors.service import DISK_REFUSES, NOT_REMEMBERED, PART_FAILED
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.messages import OutboxError, event_id
from daqsvc.outbox.store import Outbox
from daqsvc.publish.output import EarlierState, OutputPort, OutputSet, Watched, output_name
from daqsvc.publish.payloads import alarm_json, restore_alarms
from daqsvc.publish.topics import Topics
from daqsvc.self_check import JOURNAL, SelfCheck, Vitals, conditions
from daqsvc.supervision import StallWatch, Supervisor

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, SnapshotRequest
    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.alarms.manager import AlarmManager
    from daqsvc.control import TakeSnapshot
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.publish.looking import Look
    from daqsvc.publish.output import Output
    from daqsvc.self_check import BusHealth

logger = logging.getLogger(__name__)

TICK_NS = NS_PER_S
REFUSED_TICKS = 60
"""How often the number of refused commands that are only counted is logged."""
DISK_TICKS = 10
"""The disk fills slowly, and asking it may take long."""
GRACE_S = 0.1
"""What outputs may take beyond their deadline before they are left behind."""
FORGOTTEN = "the journal was damaged and its state is lost; it begins again"
UNJOURNALLED = "the service ended while the journal could not be written; it begins again"


class MadeOutputs(NamedTuple):
    """Outputs that are to take over from others.

    Attributes:
        made: by the path of its table; each is to be run.
        conditions: see `OutputSet`.
        outdated: as above.
    """

    made: dict[str, Output]
    conditions: tuple[str, ...]
    outdated: Mapping[str, str]


class AlarmService:
    """Alarms of one machine or of several, from diagnosis to broker.

    Use: `open`, `resume`, then `take` and `execute` as diagnoses and commands come while `outputs` and
    `keep_time` run; `settle`, `stop`, `close`.

    Args:
        manager: the alarms of the machine; of several ones, those of the service itself.
        store: directory of the journal and the audit log.
        clock: the service's clock.
        outputs: who gets the events; None keeps everything in the journal.
        others: the alarms of each machine, if there are several.
        limits: how much the journal may keep.
        buses: by name, what can be watched of each bus.
        bus_health: gives the state of the buses.
        supervisor: counts what outputs do wrong.
        stalls: finds the parts of the service that have stalled, for outputs that report it.
        heard: called, on the event loop, with each event.
        snapshot: makes snapshots of machines. None if none can be asked for.
        look: begins to send what happens at a machine. None if there is no such service.
    """

    def __init__(
        self,
        manager: AlarmManager,
        store: Path,
        clock: Clock,
        outputs: OutputSet | None,
        *,
        others: Iterable[AlarmManager] = (),
        limits: OutboxLimits | None = None,
        buses: Mapping[str, Collection[str]] | None = None,
        bus_health: Callable[[], Mapping[str, BusHealth]] = dict,
        supervisor: Supervisor | None = None,
        stalls: StallWatch | None = None,
        heard: Callable[[AlarmEvent], None] = lambda _event: None,
        snapshot: TakeSnapshot | None = None,
        look: Look | None = None,
    ) -> None:
        limits = limits or OutboxLimits()
        stalls = stalls or StallWatch(dict)
        identity = manager.identity
        self.manager = manager
        """The alarms of the service itself; of one machine, its own, too."""
        self.managers = {one.identity.machine: one for one in (*others, manager)}
        """By machine."""
        self.outbox = Outbox(store / "outbox.sqlite", clock, limits)
        self.audit = AuditLog(store / "audit.jsonl", clock, limits.audit_max_bytes)
        self._executor = CommandExecutor(
            self.managers,
            lambda: self.manager,
            self.audit,
            clock,
            post=self._post,
            id_of=lambda number: event_id(self.outbox.series, number),
            watch=self._watch,
            snapshot=snapshot,
        )
        self.commands = self._executor.counters
        asked = outputs or OutputSet(machines={name: Watched(name) for name in self.managers})
        self.topics = Topics(asked.topic_root, identity.site, identity.box)
        self._witness = self.topics.alarm(identity.machine, JOURNAL)
        """Every run that cannot write its disk tells the broker so, here."""
        self._witness_known: int | None = None
        """The last number on it that the journal knew at the start; None if it need not be compared."""
        self._port = OutputPort(
            machines=asked.machines,
            store=store,
            clock=clock,
            outbox=self.outbox,
            topics=self.topics,
            commands=self.execute,
            snapshots=self.take_snapshot,
            look=look,
            earlier=EarlierState(self._witness, self._take_witness),
            progress=stalls.progress,
            stalls=stalls,
        )
        self.outputs = dict(asked.make(self._port))
        """Who gets the events, by the path of its table; each is to be run by itself, until `stop`."""
        self._outdated = asked.outdated
        self._waiting_max = limits.alarms_waiting_max
        self._clock = clock
        self._supervisor = supervisor or Supervisor()
        self._heard = heard
        self._log = AlarmLog(clock, of_several=len(self.managers) > 1)
        self._conditions_of_outputs = asked.conditions
        self._conditions = [*conditions(buses or {}), *asked.conditions]
        self._bus_health = bus_health
        self._self_check = SelfCheck(store, limits.reserve_bytes)
        self._free_bytes: int | None = None
        self._under_way: set[asyncio.Future[Any]] = set()
        self._newest: dict[tuple[str, str], AlarmEvent] = {}
        self._topic_of: dict[tuple[str, str], str] = {}
        self._untold: dict[tuple[str, str], AlarmEvent] = {}
        """By alarm, its newest event if the outbox has refused that."""
        self._active_detectors: Mapping[str, Mapping[str, Sequence[str]]] = {}
        self._knows_journal = True
        """Whether the alarms have taken over what the journal knew when the service ended."""
        self._is_in_step = True
        self._catching_up = False
        self._damage_seen = 0

    async def open(self) -> None:
        """Open the journal.

        Raises:
            OutboxError: its directory cannot be used.
        """
        await self.outbox.open()

    async def resume(self, active_detectors: Mapping[str, Mapping[str, Sequence[str]]]) -> None:
        """Take over from the journal the states of the alarms when the service ended.

        Args:
            active_detectors: by machine, the detectors that will make statements, with the sensors that these
                rest on.
        """
        self._active_detectors = active_detectors
        if self.outbox.counters.shut:
            latest = await self.outbox.glimpse()
            self._knows_journal, self._is_in_step = latest is not None, False
            if latest is not None:
                self._witness_known = self._last_on_witness(latest)
            events = await asyncio.to_thread(restore_alarms, latest or (), self.topics)
            self._take_over(events)
            if self._knows_journal and self.outbox.broker_is_ahead:
                self._witness_known = None  # all of it is sent anyway
                self._confirm(self._tell_again(events))
            return
        latest = await self.outbox.latest()
        self._witness_known = self._last_on_witness(latest)
        events = await asyncio.to_thread(restore_alarms, latest, self.topics)
        self._take_over(events)
        self._damage_seen = self._damage()
        if self.outbox.broker_is_ahead:
            self._witness_known = None
            self._confirm(self._tell_again(events))
        elif self._damage_seen:
            self._confirm(self._forget(events))

    def _take_over(self, events: Sequence[AlarmEvent]) -> None:
        for event in events:
            self._newest[event.identity.machine, event.alarm] = event
        for machine, manager in self.managers.items():
            is_own = manager is self.manager
            # Those of machines that are gone are withdrawn by the service itself.
            theirs = [e for e in events if self.managers.get(e.identity.machine, self.manager) is manager]
            known = self._conditions if is_own else ()
            for event in manager.resume(theirs, self._active_detectors.get(machine, {}), known):
                self._post(event)

    def newest(self, machine: str) -> list[AlarmEvent]:
        """The last event of each alarm of a machine, from before a restart too."""
        return [event for (whose, _), event in self._newest.items() if whose == machine]

    def made_by(self, outputs: OutputSet) -> MadeOutputs:
        """Make other outputs, for `change`; may block, and be called in a thread."""
        made = outputs.make(replace(self._port, machines=outputs.machines))
        return MadeOutputs(dict(made), outputs.conditions, outputs.outdated)

    def change(
        self,
        fresh: Iterable[AlarmManager],
        *,
        gone: Collection[str],
        buses: Mapping[str, Collection[str]],
        active_detectors: Mapping[str, Mapping[str, Sequence[str]]],
        outputs: MadeOutputs | None,
    ) -> None:
        """Go on with alarms by other rules, which stand as they did: as over a restart, without one.

        Args:
            fresh: the alarms of machines that are new, or whose rules are.
            gone: machines that are no longer watched; their alarms return to normal.
            buses: see `__init__`.
            active_detectors: see `resume`.
            outputs: get the events from now on; to be run. None if the same as before are, which still do.
        """
        newest: dict[str, list[AlarmEvent]] = {}
        for (machine, _), event in self._newest.items():
            newest.setdefault(machine, []).append(event)
        self._active_detectors = active_detectors
        if outputs is not None:
            self._outdated = outputs.outdated
            self._conditions_of_outputs = outputs.conditions
            self.outputs.clear()
            self.outputs.update(outputs.made)
        self._conditions = [*conditions(buses), *self._conditions_of_outputs]
        own = self.manager.identity.machine
        for manager in fresh:
            machine = manager.identity.machine
            before = self.managers.get(machine)
            self.managers[machine] = manager
            if machine == own:
                self.manager = manager
            known = self._conditions if machine == own else ()
            events = manager.resume(newest.get(machine, ()), active_detectors.get(machine, {}), known)
            for event in [*events, *(manager.follow(before) if before is not None else ())]:
                self._post(event)
        for machine in gone:
            del self.managers[machine]
            for event in self.manager.withdraw(newest.get(machine, ())):
                self._post(event)
        self.manager.expect_conditions(self._conditions)

    def _damage(self) -> int:
        return self.outbox.counters.quarantined + self.outbox.counters.vanished

    def _forget(self, events: Iterable[AlarmEvent]) -> list[asyncio.Future[int]]:
        """Say of alarms that are no longer known that they are normal: the broker shows their last state.

        The broker has nothing about those that were never published.
        """
        ever = self.outbox.known_topics
        return [
            self._post(event)
            for event in self._begin_anew(events, FORGOTTEN)
            if ever is None or self._topic(event) in ever
        ]

    def _tell_again(self, events: Sequence[AlarmEvent]) -> list[asyncio.Future[int]]:
        """Say of every alarm its state: the broker may show what the journal never got.

        Args:
            events: what the journal knows, which the alarms have taken over.
        """
        logger.warning(
            "the service was ended while the disk took no writes: the broker may show what the journal does "
            "not know, so the state of every alarm is sent again",
            extra=coded(NOT_REMEMBERED),
        )
        again = [event for event in events if self._newest[event.identity.machine, event.alarm] is event]
        return [
            *(self._submit(event) for event in again),
            *(self._post(event) for event in self._begin_anew(events, UNJOURNALLED)),
        ]

    def _begin_anew(self, events: Iterable[AlarmEvent], reason: str) -> list[AlarmEvent]:
        """See `AlarmManager.begin_anew`, of all machines."""
        known = list(events)
        return [event for one in self.managers.values() for event in one.begin_anew(known, reason)]

    def _last_on_witness(self, latest: Iterable[OutboxMessage]) -> int:
        return max((message.sequence for message in latest if message.topic == self._witness), default=0)

    def _take_witness(self, payload: bytes) -> None:
        """See whether the broker has messages of a run that the disk has no trace of.

        Such a run leaves nothing on the disk, but its report on the journal is retained at the broker.
        """
        try:
            witness = json.loads(payload)
            number, series = int(witness["sequence"]), str(witness["id"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            logger.warning(
                "what the broker keeps on %s cannot be read: %s",
                self._witness,
                error,
                extra=coded(NOT_REMEMBERED),
            )
            return
        if self._witness_known is None or number <= self._witness_known:
            return
        if series.startswith(self.outbox.series):
            return
        logger.warning(
            "an earlier run has sent the broker what the disk never got, so the state of every alarm is sent "
            "again",
            extra=coded(NOT_REMEMBERED),
        )
        for event in [*self._newest.values()]:
            self._submit(event)
        for event in self._begin_anew([*self._newest.values()], UNJOURNALLED):
            self._post(event)

    def _topic(self, event: AlarmEvent) -> str:
        alarm = (event.identity.machine, event.alarm)
        if alarm not in self._topic_of:
            self._topic_of[alarm] = self.topics.alarm(*alarm)
        return self._topic_of[alarm]

    def _confirm(self, committed: Sequence[asyncio.Future[int]]) -> None:
        """Once these are on disk, the damage need not be reported again after a restart."""

        async def confirm() -> None:
            outcomes = await asyncio.gather(*committed, return_exceptions=True)
            if not any(isinstance(outcome, BaseException) for outcome in outcomes):
                with contextlib.suppress(OutboxError):  # it is being closed; then it is reported once more
                    self.outbox.damage_is_reported()

        self._watch(asyncio.create_task(confirm(), name="damage is reported"))

    def _falls_out_of_step(self) -> bool:
        """Whether the journal was opened late, or replaced, and has not been brought into step since."""
        counters = self.outbox.counters
        if counters.shut or counters.waiting or self._catching_up:
            return False
        return not self._is_in_step or self._damage() > self._damage_seen

    async def _catch_up(self) -> None:
        """Bring journal and alarms into step again.

        What the alarms have done since counts. An alarm that has done nothing takes over what the journal
        states, if that could not be asked before; the journal receives what it has lost.
        """
        damage = self._damage()
        before = dict(self._newest)
        try:
            events = await asyncio.to_thread(restore_alarms, await self.outbox.latest(), self.topics)
        finally:
            self._catching_up = False
        if not self._knows_journal:
            self._knows_journal = True
            self._take_over([e for e in events if (e.identity.machine, e.alarm) not in self._newest])
        stands = {(event.identity.machine, event.alarm): _moment(event) for event in events}
        committed = [
            self._submit(event)
            for alarm, event in before.items()
            if self._newest[alarm] is event and stands.get(alarm) != _moment(event)
        ]
        if damage > self._damage_seen:
            committed += self._forget([*events, *self._newest.values()])
        self._is_in_step, self._damage_seen = True, damage
        self._confirm(committed)

    async def keep_time(self) -> None:
        """Apply what time alone changes, and what the service reports about itself; until cancelled."""
        was_backed = True
        for tick in itertools.count():
            is_backed = not (self.outbox.counters.shut or self.outbox.counters.unbacked)
            if tick % DISK_TICKS == 0 or is_backed != was_backed:
                await self._look_at_disk()
            was_backed = is_backed
            if tick % REFUSED_TICKS == 0:
                await self._executor.tell_refused()
            for _ in self._tick_by_machine():
                await asyncio.sleep(0)
            await self._clock.sleep_ns(TICK_NS)

    def tick(self) -> None:
        """What time alone brings, such as the end of shelving, and how the service itself stands."""
        for _ in self._tick_by_machine():
            pass

    def _tick_by_machine(self) -> Iterator[None]:
        """See `tick`; comes back after each machine, so that others may have a turn."""
        if self._untold and self.outbox.counters.waiting <= self._waiting_max // 2:
            # Once events are taken again, broker and disk must know the state of each alarm by now.
            for event in list(self._untold.values()):
                self._submit(event)
        if self._falls_out_of_step():
            self._catching_up = True
            self._watch(asyncio.create_task(self._catch_up(), name="journal and alarms in step"))
        self._log.sum_up()
        for machine in [*self.managers]:
            if (manager := self.managers.get(machine)) is not None:  # it may have been taken out meanwhile
                for event in manager.tick():
                    self._post(event)
            yield
        for condition in (*self._of_outputs(), *self._self_check.look(self._vitals())):
            for event in self.manager.condition(*condition):
                self._post(event)

    def take(self, diagnosis: Diagnosis) -> None:
        """Take in a diagnosis; what follows from it is on its way to the disk when this returns.

        Raises:
            ValueError: it is about no machine of these.
        """
        for event in self.managers.get(diagnosis.machine, self.manager).take(diagnosis):
            self._post(event)

    async def execute(self, command: AlarmCommand, source: str) -> CommandOutcome:
        """See `CommandExecutor.execute`."""
        return await self._executor.execute(command, source)

    async def take_snapshot(self, command: SnapshotRequest, source: str) -> CommandOutcome:
        """See `CommandExecutor.take_snapshot`."""
        return await self._executor.take_snapshot(command, source)

    def figures(self) -> dict[str, Any]:
        """How many alarms stand, are covered or unacknowledged by now, and what has happened so far."""
        figures: Counter[str] = Counter()
        for machine in self.managers:
            figures.update(self.figures_of(machine))
        return dict(figures)

    def figures_of(self, machine: str) -> dict[str, int]:
        """The same of one machine."""
        counted = self.managers[machine].counters
        shown = self.managers[machine].shown
        return {
            "active": sum(count for state, count in shown.items() if state.is_active),
            "unacknowledged": sum(c for state, c in shown.items() if state.value.endswith("_unacknowledged")),
            "latched": sum(count for state, count in shown.items() if state.is_latched),
            "suppressed": shown.get(AlarmState.SUPPRESSED, 0),
            "shelved": shown.get(AlarmState.SHELVED, 0),
            "out_of_service": shown.get(AlarmState.OUT_OF_SERVICE, 0),
            "events": counted.events,
            "annunciations": counted.annunciations,
            "chattering": counted.chattering,
            "floods": counted.floods,
        }

    async def settle(self, timeout_s: float) -> None:
        """Take no more commands, and wait until what is under way is on disk, at most so long."""
        self._executor.stop()
        telling = asyncio.create_task(self._executor.tell_refused(), name="refused commands")
        await asyncio.wait({telling, *self._under_way}, timeout=timeout_s)

    async def stop(self, deadline_s: float) -> None:
        """Hand over what is left, and end `outputs`; see `Output.stop`."""
        stopping = {
            asyncio.create_task(_stop(output, deadline_s), name=f"{output_name(path)} stop")
            for path, output in self.outputs.items()
        }
        if not stopping:
            return
        ended, hanging = await asyncio.wait(stopping, timeout=deadline_s + GRACE_S)
        for task in hanging:
            task.cancel()
        for task in ended:
            if not task.cancelled() and (error := task.exception()) is not None:
                logger.error("%s has failed: %s", task.get_name(), error, extra=coded(PART_FAILED))

    async def close(self, timeout_s: float) -> None:
        """Close the journal; see `Outbox.close`."""
        await self.outbox.close(timeout_s)

    def _of_outputs(self) -> Iterator[Condition]:
        """The state of the outputs; reports of an output that is no longer there are dropped."""
        raised = self.manager.conditions
        for path, output in self.outputs.items():
            with self._supervisor.sparing_others(
                output_name(path), "it reports nothing about itself until then"
            ):
                yield from [*output.conditions(raised)]
        for prefix, sentence in self._outdated.items():
            for name in sorted(raised):
                if name.startswith(prefix):
                    yield Condition(name, Level.NORMAL, sentence)

    def _vitals(self) -> Vitals:
        outbox = self.outbox.counters
        return Vitals(
            now_ns=self._clock.monotonic_ns(),
            conditions_reported=self.manager.conditions,
            free_bytes=self._free_bytes,
            waiting=outbox.waiting,
            write_errors=outbox.write_errors,
            lost=outbox.refused + outbox.lost,
            unbacked=bool(outbox.shut or outbox.unbacked),
            damaged=outbox.quarantined
            + outbox.vanished
            + outbox.telemetry.quarantined
            + self.outbox.command_ids_lost,
            set_aside=self.outbox.has_set_aside,
            telemetry_dropped=outbox.telemetry.dropped,
            unwritten=self.commands.unwritten,
            buses=self._bus_health(),
        )

    async def _look_at_disk(self) -> None:
        try:
            self._free_bytes = await asyncio.to_thread(self._self_check.free_bytes)
        except OSError as error:
            if self._free_bytes is not None:
                logger.error(  # noqa: TRY400 - the message is enough
                    "it is not known how full the disk of the journal is: %s",
                    error,
                    extra=coded(DISK_REFUSES),
                )
            self._free_bytes = None

    def _post(self, event: AlarmEvent) -> asyncio.Future[int]:
        self._log.say(event)
        committed = self._submit(event)
        with self._supervisor.sparing_others("recorder", "it does not get one alarm event"):
            self._heard(event)
        return committed

    def _submit(self, event: AlarmEvent) -> asyncio.Future[int]:
        alarm = (event.identity.machine, event.alarm)
        self._newest[alarm] = event
        self._untold.pop(alarm, None)
        try:
            committed = self.outbox.submit(
                self._topic(event),
                lambda sequence: alarm_json(event, sequence, self.outbox.series),
                retain=True,
            )
        except OutboxError as error:
            committed = asyncio.get_running_loop().create_future()
            committed.set_exception(error)
        self._under_way.add(committed)
        committed.add_done_callback(lambda done: self._settled(event, done))
        return committed

    def _settled(self, event: AlarmEvent, committed: asyncio.Future[int]) -> None:
        """Remember the alarms whose newest event the disk has refused: their states must be written again."""
        self._under_way.discard(committed)
        if committed.cancelled() or (error := committed.exception()) is None:
            return
        logger.error(
            "an event of alarm %s never reached the disk: %s", event.alarm, error, extra=coded(DISK_REFUSES)
        )
        alarm = (event.identity.machine, event.alarm)
        if self._newest[alarm] is event:
            self._untold[alarm] = event

    def _watch(self, work: asyncio.Future[Any]) -> None:
        self._under_way.add(work)
        work.add_done_callback(self._under_way.discard)


async def _stop(output: Output, deadline_s: float) -> None:
    """See `Output.stop`; whatever it raises is the task's."""
    await output.stop(deadline_s)


def _moment(event: AlarmEvent) -> tuple[object, ...]:
    """What tells an event from others of its alarm, in memory and read back alike."""
    return event.t_ns, event.wall_ns, event.kind, event.to_state, event.to_level
