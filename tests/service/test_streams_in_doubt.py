"""A wrong rate, and a counter that stands still, reach a person as a quality alarm of a running service.

Meanwhile no limit is judged by such a stream: nothing is raised by it, and nothing returns to normal.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from support.live_service import running, watch_of
from support.machine_files import LAVAL
from support.rogue_buses import machine_text
from support.rogue_devices import NOMINAL_HZ, Phase, RogueDevices
from support.waiting import eventually

from daqsvc.settings import parse_machine_file

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.service import Service

pytestmark = pytest.mark.integration
WRONG, STILL = ("can", "tcp"), ("cobs", "rtu")
KINDS = (*WRONG, *STILL)
LIMIT = """
[[alarms]]
name = "limit-{0}"
sensor = "s-{0}"
measure = "rms"
alert = 1.0
danger = 3.0
"""
LOUD = Phase("loud", values="loud")
CALM_AND_TWICE = Phase("calm and twice", per_s=2 * NOMINAL_HZ)
"""Whatever comes before a rate is known has to be judged some time, and raises no limit."""
RATE = re.compile(rf"the device sends [\d.]+ Hz, the file states {NOMINAL_HZ:g}\b")
RATE_WRONG = re.compile(rf"the device sends (9[5-9]|10[0-5])(\.\d+)? Hz, the file states {NOMINAL_HZ:g}\b")
COUNTER_STILL = "the device's counter stands still at 3000000077; check the device"


class Events:
    """What the alarms of a service have said."""

    def __init__(self, service: Service) -> None:
        self.all: list[AlarmEvent] = []
        manager, take = service.alarms.manager, service.alarms.manager.take

        def heard(diagnosis):  # type: ignore[no-untyped-def]
            events = take(diagnosis)
            self.all += events
            return events

        manager.take = heard  # type: ignore[method-assign]

    def of(self, alarm: str) -> list[str]:
        return [event.kind.value for event in self.all if event.alarm == alarm]

    def words(self, alarm: str) -> list[str]:
        return [event.message for event in self.all if event.alarm == alarm]


@pytest.mark.long
async def test_streams_in_doubt_are_quality_alarms_and_no_others(tmp_path: Path) -> None:
    await be_in_doubt(tmp_path, and_recover=False)


@pytest.mark.long
async def test_streams_in_doubt_are_judged_again(tmp_path: Path) -> None:
    await be_in_doubt(tmp_path, and_recover=True)


async def be_in_doubt(folder: Path, *, and_recover: bool) -> None:
    """Play wrong rates and still counters to a service; then, if asked to, what is right again."""
    with RogueDevices(folder, 3) as devices:
        text = machine_text(KINDS, devices) + "".join(map(LIMIT.format, KINDS))
        # A unit that answers late is asked again in a minute only: none is late that the machine holds up.
        text = text.replace("timeout_ms = 50.0", "timeout_ms = 10_000.0")
        machine = parse_machine_file(text, LAVAL)
        async with running(machine, folder / "store") as service:
            events = Events(service)
            await eventually(lambda: all(d.link.state == "up" for d in service.drivers[:1]), "the bus is up")
            devices.play(machine, {kind: [LOUD if kind in STILL else CALM_AND_TWICE] for kind in KINDS}, 0.1)
            nodes = {node.name: node for node in devices.nodes}
            for name in WRONG:
                await eventually(
                    lambda n=name: any(map(RATE.search, events.words(f"sensor-ok/s-{n}"))),
                    f"{name}: the rate is said",
                )
                await eventually(
                    lambda n=name: RATE_WRONG.match(service.figures()["streams"][n]["doubt"]),
                    f"{name}: the rate is right",
                )
                nodes[name].phases = [LOUD._replace(name="twice", per_s=2 * NOMINAL_HZ)]
                begun = watch_of(service).rings[name].end_index
                await eventually(
                    lambda n=name, end=begun + 400: watch_of(service).rings[n].end_index > end,
                    f"{name}: there are windows enough that are loud",
                )
            # One that is asked would answer all the same, and its counter stand still.
            nodes["can"].phases = [Phase("stopped", per_s=0.0)]
            nothing = "no samples of stream 'can' for more than "
            await eventually(lambda: nothing in events.words("sensor-ok/s-can")[-1], "the device has stopped")
            assert service.figures()["streams"]["can"]["doubt"].startswith(nothing)
            for name in STILL:
                await eventually(lambda n=name: events.of(f"limit-{n}"), f"{name}: the limit is passed")
                nodes[name].phases = [Phase("still", counter="still")]
            for name in STILL:
                await eventually(
                    lambda n=name: any(COUNTER_STILL in said for said in events.words(f"sensor-ok/s-{n}")),
                    f"{name}: the counter is said",
                )
                assert events.of(f"limit-{name}") == ["raised"], "quiet values of a counter that stands still"
                # A machine that stands still for long hears nothing of it meanwhile.
                await eventually(
                    lambda n=name: service.figures()["streams"][n]["doubt"] == COUNTER_STILL,
                    f"{name}: so the stream stands",
                )
                nodes[name].phases = [Phase("calm")]
            for name in WRONG:
                assert events.of(f"limit-{name}") == [], "loud values at a wrong rate"
                nodes[name].phases = [LOUD]
            if not and_recover:
                return
            for name in STILL:
                await eventually(lambda n=name: "returned" in events.of(f"limit-{n}"), f"{name}: it is quiet")
                # Good again is what has been good for some seconds.
                await eventually(
                    lambda n=name: events.of(f"sensor-ok/s-{n}")[-1] == "returned",
                    f"{name}: it is good again",
                )
            for name in WRONG:
                await eventually(lambda n=name: "raised" in events.of(f"limit-{n}"), f"{name}: it is judged")
                # Good again is what has been good for some seconds.
                await eventually(
                    lambda n=name: events.of(f"sensor-ok/s-{n}")[-1] == "returned",
                    f"{name}: it is good again",
                )
