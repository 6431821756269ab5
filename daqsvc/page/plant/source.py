"""Where the page gets what it shows of a plant: from the broker that its boxes publish to."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from functools import partial
from typing import TYPE_CHECKING, Any

from daqsvc.alarms.commands import CommandOutcome
from daqsvc.errors.command_line import NO_SERVICE, NO_SUCH_MACHINE
from daqsvc.errors.outputs import BROKER_AWAY
from daqsvc.page.listening import Listenings
from daqsvc.page.plant.known import KnownPlant
from daqsvc.page.plant.leased import LeasedListening
from daqsvc.page.plant.link import BrokerAwayError, BrokerLink
from daqsvc.page.sources import NotToldError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daqsvc.alarms.commands import AlarmCommand
    from daqsvc.errors.code import Code
    from daqsvc.page.box_snapshots import KeptSnapshot
    from daqsvc.page.sources import Heard
    from daqsvc.publish.mqtt.settings import Mqtt

    Document = dict[str, Any]

log = logging.getLogger(__name__)

LINGER_S = 5.0
"""How long a machine is still listened to after the last viewer has gone."""
BEGIN_S = 3.0
"""How long the broker is waited for at first."""
LOOK_S = 0.05


class PlantSource:
    """The machines of all boxes that publish to a broker; see `daqsvc.page.sources.MachineSource`.

    Args:
        mqtt: the broker.
    """

    def __init__(self, mqtt: Mqtt) -> None:
        self._known = KnownPlant(mqtt.topic_root)
        self._link = BrokerLink(mqtt, self._known)
        self._begun_s = 0.0
        self._running: asyncio.Task[None] | None = None
        self._listenings = Listenings(LINGER_S)

    def begin(self) -> None:
        """Begin to listen to the broker, if that has not been done."""
        if self._running is None:
            self._begun_s = asyncio.get_running_loop().time()
            self._running = asyncio.create_task(self._link.run(), name="listen to the broker")

    async def statuses(self) -> list[Document]:
        """See `daqsvc.page.sources.MachineSource.statuses`.

        Raises:
            NotToldError: the broker is away.
        """
        await self._begun("")
        if self._link.why_not:
            raise NotToldError(self._link.why_not)
        statuses = []
        for box in [*self._known.boxes.values()]:
            about = {"place": f"{box.site}, {box.box}", "away": box.away}
            for machine in [*box.machines.values()]:
                standing = [one for one in machine.alarms.values() if one["state"] != "normal"]
                statuses.append({"machine": machine.name, "alarms": {"standing": standing}, **about})
            if not box.machines:
                away = box.away or "no machine of this box has sent anything yet"
                statuses.append({"machine": "", "alarms": {"standing": []}, **about, "away": away})
        return statuses

    async def _begun(self, machine: str) -> None:
        """Wait, soon after the start, until the broker has sent something about a machine, or about any."""
        self.begin()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(self._begun_s + BEGIN_S):
                while self._link.why_not or not self._has_heard(machine):  # noqa: ASYNC110 - at the begin only
                    await asyncio.sleep(LOOK_S)

    def _has_heard(self, machine: str) -> bool:
        if machine:
            return self._known.machine(machine) is not None
        return any(box.machines for box in self._known.boxes.values())

    @contextlib.asynccontextmanager
    async def looking(self, machine: str) -> AsyncIterator[Heard]:
        """See `daqsvc.page.sources.MachineSource.looking`.

        Raises:
            KeyError: nothing was heard of such a machine.
        """
        if machine not in self._listenings:
            await self._begun(machine)
        box_and_machine = self._known.machine(machine)
        if box_and_machine is None:
            raise KeyError(machine)
        with self._listenings.looking(
            machine, partial(LeasedListening, self._link, *box_and_machine)
        ) as listening:
            yield listening

    async def journal(self, machine: str, alarm: str, most: int) -> list[Document]:
        """See `daqsvc.page.sources.MachineSource.journal`; what the broker keeps, and what came since."""
        box_and_machine = self._known.machine(machine)
        events: list[Document] = (
            [] if box_and_machine is None else [*map(json.loads, reversed(box_and_machine[1].events))]
        )
        events.sort(key=lambda one: -int(one["wall_ns"]))
        return [one for one in events if alarm in {"", one["alarm"]}][:most]

    async def snapshots(self, machine: str) -> list[KeptSnapshot]:
        """See `daqsvc.page.sources.MachineSource.snapshots`.

        Raises:
            NotToldError: they are on the box.
        """
        del machine
        raise NotToldError("the snapshots are on the box: its own page shows them")

    async def handle(self, machine: str, command: AlarmCommand, denied: str, via: str) -> CommandOutcome:
        """See `daqsvc.page.sources.MachineSource.handle`: as a command over the broker."""
        box_and_machine = self._known.machine(machine)
        if box_and_machine is None:
            return _refused(f"there is no {machine!r} here", NO_SUCH_MACHINE)
        box, known = box_and_machine
        asked: Document = {"alarm": command.alarm, "by": command.by, "reason": command.reason}
        if command.duration_s is not None:
            asked["duration_s"] = command.duration_s
        if command.occurrence is not None:
            asked["occurrence"] = command.occurrence
        if denied:
            asked["denied"] = denied
        log.info(
            "%s asks: %s %s of %s, %s", via, command.verb, command.alarm, machine, denied or "as operator"
        )
        topic = self._link.topics_of(known).command(known.machine, command.verb)
        try:
            answer = await self._link.command(topic, asked)
        except BrokerAwayError as error:
            return _refused(f"{error}", BROKER_AWAY)
        if answer is None:
            why = box.away or "it takes commands only if its machine file allows it in [mqtt.commands]"
            return _refused(f"the box has not answered: {why}", NO_SERVICE)
        code = answer.get("code")
        return CommandOutcome(
            accepted=bool(answer.get("accepted")),
            reason=f"{answer.get('reason', '')}",
            code=code if isinstance(code, str) else None,
        )

    async def close(self) -> None:
        """Listen no more."""
        if self._running is not None:
            self._running.cancel()  # at first: without waiting for a broker that does not answer
        await self._listenings.close()
        if self._running is not None:
            await asyncio.wait({self._running})


def _refused(reason: str, code: Code) -> CommandOutcome:
    return CommandOutcome(accepted=False, reason=reason, code=code.id)
