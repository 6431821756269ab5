"""What the edge node tells of the time in which nobody listened."""

from __future__ import annotations

import pytest
from support.brokers import Mosquitto
from support.sparkplug_edge import (
    EVENT,
    STATE,
    Machine,
    born,
    edge_node,
)
from support.sparkplug_host import Host
from support.waiting import eventually

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]


@pytest.mark.long
async def test_alarms_of_an_outage_come_as_history_after_the_births(outbox, tmp_path) -> None:
    """Nothing that was raised while no broker was there is lost, and the order holds."""
    machine = Machine(outbox)
    mosquitto = Mosquitto(tmp_path)
    mosquitto.start()
    try:
        async with edge_node(outbox, tmp_path, mosquitto.port) as edge:
            async with Host(mosquitto.port) as host:
                await born(host)
                await machine.flips(1)
                await eventually(lambda: len(host.told(EVENT, historical=False)) == 2, "it is told")
            mosquitto.stop()
            await machine.flips(70)
            mosquitto.start()
            async with Host(mosquitto.port) as host:
                await eventually(lambda: edge.counters.historical >= 140, "the history is told")
                await machine.says("F99")
                await eventually(lambda: host.told(EVENT, historical=False), "the next one is told live")
                events = host.told(EVENT, historical=True)
                numbers = [int(event.rpartition("-")[2]) for event in events]
                assert numbers == sorted(numbers)
                assert len(set(numbers)) == 140
                states = host.told(STATE, historical=True)
                assert states == ["active_unacknowledged", "returned_unacknowledged"] * 70
    finally:
        mosquitto.stop()


async def test_history_is_not_told_twice_after_a_restart(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(mosquitto.port) as host:
        async with edge_node(outbox, tmp_path, mosquitto.port):
            await born(host)
            await machine.flips(5)
            await eventually(lambda: len(host.told(EVENT, historical=False)) == 10, "all are told")
        async with edge_node(outbox, tmp_path, mosquitto.port) as edge:
            await born(host, 2)
            await machine.says("F9")
            await eventually(lambda: edge.counters.alarms == 1, "the next one is told")
            assert edge.counters.historical == 0


async def test_a_box_that_begins_with_sparkplug_tells_no_history_of_before(
    mosquitto, outbox, tmp_path
) -> None:
    machine = Machine(outbox)
    await machine.flips(5)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port) as edge:
        await born(host)
        await machine.says("F9")
        await eventually(lambda: edge.counters.alarms == 1, "the next one is told")
        assert edge.counters.historical == 0
