"""An edge node under test, and a machine whose alarms it tells."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from support.mqtt_publishing import mqtt, output_port
from support.ports import LOOPBACK
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.output import Watched
from daqsvc.publish.payloads import alarm_payload
from daqsvc.publish.sparkplug.codec import DataType, Metric, Payload, encode
from daqsvc.publish.sparkplug.edge import SparkplugEdge
from daqsvc.publish.sparkplug.settings import Sparkplug
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable
    from pathlib import Path

    from support.sparkplug_host import Host

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.diagnosis.record import Severity
    from daqsvc.outbox.store import Outbox

CLOCK = SystemClock()
TOPICS = Topics("daqsvc", "lab", "edge-1")
NODE = "spBv1.0/lab/{}/edge-1"
REBIRTH = "Node Control/Rebirth"
STATE = "Alarms/rig/rotor-fault/State"
EVENT = "Alarms/rig/rotor-fault/Event"
BOOLEAN, INT64, STRING, DOUBLE = 11, 4, 12, 10
READINGS = (
    Reading("bank", "statistics", "speed", "rpm"),
    Reading("bank", "probabilities", "F1"),
)


def said(decision: str, severity: Severity = "alert", speed: float = 600.0) -> Diagnosis:
    return Diagnosis(
        machine="rig",
        detector="bank",
        t_ns=CLOCK.monotonic_ns(),
        stream="shaft",
        first_index=0,
        end_index=64,
        decision=decision,
        changed=True,
        severity=severity,
        probabilities={"F1": 0.75},
        statistics={"speed": speed},
        sensors=("x",),
        group=(decision,),
    )


def _payload(event: AlarmEvent, sequence: int) -> bytes:
    return alarm_payload(event, sequence, "series").to_json()


class Machine:
    """Alarms into the outbox, as the service puts them there."""

    def __init__(self, outbox: Outbox, alarms: tuple[str, ...] = ("rotor-fault",)) -> None:
        self._outbox = outbox
        self._manager = AlarmManager(
            Identity("lab", "edge-1", "rig"), [DiagnosisRule(name, "bank") for name in alarms], CLOCK
        )

    async def says(self, decision: str, severity: Severity = "alert") -> None:
        await self._tell(self._manager.take(said(decision, severity)))

    async def shelves(self) -> None:
        command = AlarmCommand(verb=Verb.SHELVE, alarm="rotor-fault", by="me", duration_s=60.0)
        await self._tell(self._manager.execute(command))

    async def _tell(self, events: Iterable[AlarmEvent]) -> None:
        for event in events:
            topic = TOPICS.alarm("rig", event.alarm)
            await self._outbox.append(
                topic,
                partial(_payload, event),
                retain=True,
            )

    async def flips(self, times: int) -> None:
        """Raise and return the alarm, so often; two events each time."""
        for number in range(times):
            await self.says(f"F{number}")
            await self.says("N", "normal")


@contextlib.asynccontextmanager
async def edge_node(
    outbox: Outbox, tmp_path: Path, *ports: int, primary_host: str | None = None, protocol: str = "5"
) -> AsyncIterator[SparkplugEdge]:
    settings = Sparkplug(
        servers=tuple(f"mqtt://{LOOPBACK}:{port}" for port in ports),
        client_id="edge-1-sparkplug",
        primary_host=primary_host,
    )
    watched = Watched("rig", alarms=("rotor-fault",), readings=READINGS, buses=("can0",))
    port = replace(output_port(outbox, watched, clock=CLOCK), store=tmp_path)
    edge = SparkplugEdge(settings, mqtt(ports[0], "edge-1", protocol=protocol), port)
    running = asyncio.create_task(edge.run())
    try:
        yield edge
    finally:
        await edge.stop(5.0)
        await running


def rebirth(*, value: Any = True, name: str = REBIRTH, datatype: DataType = DataType.BOOLEAN) -> bytes:
    return encode(Payload(1, None, (Metric(name=name, timestamp_ms=1, datatype=datatype, value=value),)))


async def born(host: Host, times: int = 1) -> None:
    await eventually(lambda: len(host.of("DBIRTH")) >= times, f"birth number {times}")
