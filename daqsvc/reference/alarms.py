"""The page of the alarms that every service has by itself, and of the states and events of all alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.alarms.conditions import ALARM_FLOOD, RESERVED, TRIP_MULTIPLY
from daqsvc.alarms.events import EventKind
from daqsvc.alarms.quality import PREFIXES
from daqsvc.alarms.states import AlarmState
from daqsvc.publish.mqtt.conditions import CERTIFICATE, REFUSED
from daqsvc.reference.markdown import code, page, table
from daqsvc.self_check import BUS_CONTROLLER, BUS_OVERRUN, BUS_RECORDING, STORE

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

OWN: Mapping[str, str] = {
    "sensor-ok/": "samples of the sensor are missing, or it is not OK",
    "detector-ok/": "samples of the detector are missing, or a sensor that it rests on is not OK",
    ALARM_FLOOD: "more alarms came within `flood_window_s` than `flood_alarms` of `[alarm_handling]`, and "
    "not yet fewer than half as many; its message names the alarms that came first",
    TRIP_MULTIPLY: "a start-up has multiplied the limits of alarms for longer than it may last",
    "store/disk": "less is free on the disk than `reserve_mb` of `[store]`",
    "store/journal": "alarm events are not written to the disk",
    "store/damage": "a damaged file of the store was set aside in the last minute",
    "store/telemetry": "telemetry was dropped in the last minute",
    "store/audit-log": "a command was refused in the last minute because it could not be logged",
    "broker/refused": "the broker refuses messages on some topic",
    "certificate/": "the certificate `client`, `ca` or `broker` ends in less than 14 days, or has ended",
    "bus-overrun/": "frames or bytes of the bus were lost in a full buffer in the last minute",
    "bus-controller/": "the CAN controller of the bus is error-passive or bus-off",
    "bus-recording/": "frames of the bus could not be recorded in the last minute",
}
"""Alarms of the service itself; behind a slash at the end stands the name of what they are about."""
STATES: Mapping[str, str] = {
    "normal": "the condition is not present, and nothing is to be done",
    "active_unacknowledged": "the condition is present, and nobody has acknowledged it",
    "active_acknowledged": "the condition is present, and somebody has acknowledged it",
    "returned_unacknowledged": "the condition has gone before anybody acknowledged it",
    "latched_unacknowledged": "it has gone, nobody has acknowledged it, and the alarm waits to be reset",
    "latched_acknowledged": "the condition has gone, and the alarm waits to be reset",
    "shelved": "a person has put the alarm aside for a stated time",
    "suppressed": "a sensor that the alarm rests on is not OK",
    "out_of_service": "a person has taken the alarm out of service",
}
EVENTS: Mapping[str, str] = {
    "raised": "a new occurrence begins",
    "escalated": "the level has risen",
    "lowered": "the level has fallen, but not to normal",
    "changed": "the cause is known better, or is different, at the same level; or the limits have changed",
    "returned": "the condition has gone",
    "latched": "the condition has gone, and the alarm waits to be reset",
    "recurred": "the condition has come back before the alarm was reset",
    "acknowledged": "a person has acknowledged the alarm",
    "reset": "a person has reset the alarm",
    "suppressed": "a sensor that the alarm rests on is not OK",
    "unsuppressed": "the sensors of the alarm are good again",
    "shelved": "a person has put the alarm aside for a stated time, or changed that time",
    "unshelved": "that time is over, or a person has ended it",
    "bypassed": "a person has taken the alarm out of service",
    "unbypassed": "a person has put the alarm back into service",
    "chattering": "the alarm was raised so often that its returns are held back",
    "quiet": "the alarm does not chatter any more",
}


MARKS: Mapping[str, str] = {
    "first_out": "the alarm was the first active one of its `first_out_group`, which is where to look for "
    "the cause; `daqsvc alarms` writes `first out` behind its state. It stays until all of the group are "
    "normal",
    "chattering": "the alarm came and went so often that its returns are held back until it is quiet",
}
"""What is reported about an alarm beside its state."""


def gaps() -> Iterator[str]:
    """Alarms of the service, states and kinds of events that nothing describes."""
    alarms = (
        *PREFIXES,
        *sorted(RESERVED),
        *STORE,
        REFUSED,
        CERTIFICATE,
        BUS_OVERRUN,
        BUS_CONTROLLER,
        BUS_RECORDING,
    )
    for what, names, known in (
        ("alarm", alarms, OWN),
        ("state", [*AlarmState], STATES),
        ("event", [*EventKind], EVENTS),
    ):
        for name in names:
            if name not in known:
                yield f"{what} {name} is described nowhere: daqsvc.reference.alarms"


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    own = ((code(f"{name}NAME" if name.endswith("/") else name), text) for name, text in OWN.items())
    return {
        "alarms.md": page(
            "Alarms, their states and events",
            _ABOUT,
            "## Alarms of the service",
            "Beside the alarms of the machine file. `NAME` is a sensor, a detector, a certificate or a bus.",
            table(("alarm", "active while"), own),
            "## States",
            table(("state", "what it means"), ((code(name), text) for name, text in STATES.items())),
            "## Marks",
            table(("mark", "what it means"), ((code(name), text) for name, text in MARKS.items())),
            "## Kinds of events",
            table(("kind", "why the event was sent"), ((code(name), text) for name, text in EVENTS.items())),
        )
    }


_ABOUT = """Names of alarms, states and events as they are in messages, in the log and in `daqsvc
alarms`. In the log each event is a line `alarm NAME KIND: MESSAGE`, e.g. `alarm rotor-fault escalated: ...`.
KIND is one of the kinds below; the message states the condition of the alarm after it. When exactly an alarm
becomes active and returns: [alarms.md](../alarms.md); what to do about those of the service:
[commands.md](../commands.md)."""
