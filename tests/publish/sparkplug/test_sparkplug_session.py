"""Sessions of the edge node: will, birth and death numbers, primary host, several brokers.

Tests that check a rule of the Sparkplug 3.0 specification carry its assertion id, ``tck-id-...``, with
underscores.
"""

from __future__ import annotations

import asyncio

import pytest
from support.brokers import TcpProxy, running_mosquitto
from support.ports import LOOPBACK, free_port
from support.sparkplug_edge import (
    INT64,
    NODE,
    born,
    edge_node,
)
from support.sparkplug_host import Host
from support.waiting import eventually

from daqsvc.notice import NOTICE
from daqsvc.publish.sparkplug import session

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]

IS_THERE = "is online; births, alarms and figures go out"


async def test_tck_id_topics_nbirth_bdseq_matching(mosquitto, outbox, tmp_path) -> None:
    """The will of each session carries the number of its birth, and the next session has the next number."""
    async with TcpProxy(mosquitto.port) as proxy, Host(mosquitto.port) as host:
        async with edge_node(outbox, tmp_path, proxy.port):
            await born(host)
            proxy.cut()
            await born(host, 2)
        await eventually(lambda: len(host.of("NDEATH")) == 2, "both sessions have died")
        births = [message.metric("bdSeq") for message in host.of("NBIRTH")]
        deaths = [message.metric("bdSeq") for message in host.of("NDEATH")]
        assert [(metric.value, metric.datatype) for metric in births] == [(0, INT64), (1, INT64)]
        assert [metric.value for metric in deaths] == [0, 1]


async def test_tck_id_payloads_ndeath_will_message(mosquitto, outbox, tmp_path) -> None:
    async with (
        TcpProxy(mosquitto.port) as proxy,
        Host(mosquitto.port) as host,
        edge_node(outbox, tmp_path, proxy.port),
    ):
        await born(host)
        proxy.blocked = True
        proxy.cut()
        await eventually(lambda: host.of("NDEATH"), "the broker publishes the will")
        death = host.of("NDEATH")[0]
        assert (death.topic, death.qos, death.retain) == (NODE.format("NDEATH"), 1, False)
        assert death.seq is None
        assert [metric.name for metric in death.metrics] == ["bdSeq"]


async def test_tck_id_topics_nbirth_bdseq_increment_over_failed_connects(mosquitto, outbox, tmp_path) -> None:
    """Only sessions count: connections that never came about use no number up, a restart forgets none."""
    async with Host(mosquitto.port) as host:
        async with edge_node(outbox, tmp_path, mosquitto.port):
            await born(host)
        async with edge_node(outbox, tmp_path, free_port()) as away:
            await eventually(lambda: away._backoff._ceiling_ns > 6e9, "several connections have failed")
        async with edge_node(outbox, tmp_path, mosquitto.port):
            await born(host, 2)
        assert [message.value("bdSeq") for message in host.of("NBIRTH")] == [0, 1]


async def test_tck_id_message_flow_edge_node_ncmd_subscribe(mosquitto, outbox, tmp_path) -> None:
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        log = mosquitto.log_text
        ours = log[log.index("as edge-1-sparkplug") :]
        assert 0 < ours.index(f"{NODE.format('NCMD')} (QoS 1)") < ours.index("Received PUBLISH from edge-1")
        assert 0 < ours.index(f"{NODE.format('DCMD')}/+ (QoS 1)") < ours.index("Received PUBLISH from edge-1")


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
async def test_tck_id_principles_persistence_clean_session(outbox, tmp_path, protocol) -> None:
    connects: list[bytes] = []

    async def take(reader, writer) -> None:
        connects.append(await reader.read(4096))
        writer.close()

    server = await asyncio.start_server(take, LOOPBACK, 0)
    try:
        port = server.sockets[0].getsockname()[1]
        async with edge_node(outbox, tmp_path, port, protocol=protocol):
            await eventually(lambda: connects, "the connection is asked for")
    finally:
        server.close()
        await server.wait_closed()
    packet = connects[0]
    at = packet.index(b"\x00\x04MQTT") + 6
    level, flags = packet[at], packet[at + 1]
    assert level == (4 if protocol == "3.1.1" else 5)
    assert flags & 0b10, "clean session, or clean start"
    assert flags & 0b100, "with a will"
    assert (flags >> 3 & 0b11, flags >> 5 & 1) == (1, 0), "of QoS 1, not retained"
    session_expiry = 0x11
    assert protocol == "3.1.1" or session_expiry not in packet[at + 4 : at + 5 + packet[at + 4]]


async def test_tck_id_message_flow_edge_node_birth_publish_phid_wait(mosquitto, outbox, tmp_path) -> None:
    async with Host(mosquitto.port) as host:
        host.say_state(online=False, timestamp=1000)
        async with edge_node(outbox, tmp_path, mosquitto.port, primary_host="scada") as edge:
            await eventually(lambda: "STATE/scada (QoS 1)" in mosquitto.log_text, "the node listens")
            host.say_state(online=True, timestamp=999)
            await eventually(lambda: edge.counters.states_refused == 1, "the old word is left alone")
            assert not host.messages
            host.say_state(online=True, timestamp=1001)
            await born(host)


async def test_a_host_of_sparkplug_2_2_is_waited_for_and_followed(mosquitto, outbox, tmp_path) -> None:
    async with Host(mosquitto.port) as host:
        host.say_word("OFFLINE")
        async with edge_node(outbox, tmp_path, mosquitto.port, primary_host="scada") as edge:
            await eventually(lambda: "STATE/scada (QoS 1)" in mosquitto.log_text, "the node listens")
            host.say_word("on line")
            await eventually(lambda: edge.counters.states_refused == 1, "the word is none")
            assert not host.messages
            host.say_word("ONLINE")
            await born(host)
            host.say_word("OFFLINE")
            await eventually(lambda: host.of("NDEATH"), "the node dies")
            host.say_word("ONLINE")
            await born(host, 2)


@pytest.mark.gives("O20")
async def test_a_host_that_never_comes_is_said_with_those_that_are_there(
    mosquitto, outbox, tmp_path, monkeypatch, caplog
) -> None:
    monkeypatch.setattr(session, "HOST_REPORT_S", 0.3)
    monkeypatch.setattr(session, "LOOK_S", 0.3)
    async with Host(mosquitto.port, "scada-1") as host, Host(mosquitto.port, "old") as old:
        host.say_state(online=True, timestamp=1000)
        old.say_word("ONLINE")
        async with edge_node(outbox, tmp_path, mosquitto.port, primary_host="scada1") as edge:
            await eventually(lambda: "hosts at this broker are" in caplog.text, "it is said")
            assert edge.counters.waiting_for_host
            assert "primary host scada1 has sent no state that can be read" in caplog.text
            assert "on spBv1.0/STATE/scada1 or STATE/scada1;" in caplog.text
            assert "hosts at this broker are 'old', 'scada-1'" in caplog.text
            await eventually(lambda: "UNSUBACK" in mosquitto.log_text, "others are listened to no longer")
            assert not host.messages
            async with Host(mosquitto.port, "scada1") as wanted:
                wanted.say_state(online=True, timestamp=1)
                await born(host)
                await eventually(lambda: IS_THERE in caplog.text, "it is said that it is there")
                assert not edge.counters.waiting_for_host
                wanted.say_state(online=False, timestamp=2)
                await eventually(lambda: "scada1 has left this broker" in caplog.text, "it has gone")
                assert caplog.text.count(IS_THERE) == 1
                wanted.say_state(online=True, timestamp=3)
                await born(host, 2)
                await eventually(lambda: caplog.text.count(IS_THERE) == 2, "and is there again")
    assert caplog.text.count("Sparkplug sends nothing yet") == 1


@pytest.mark.gives("O09")
async def test_a_host_that_is_there_at_once_and_a_broker_that_comes_late_are_said_rightly(
    mosquitto, outbox, tmp_path, caplog
) -> None:
    """Nothing of a host that nobody has missed; of each broker that it is away, and one where it goes on."""
    dead = free_port()
    async with Host(mosquitto.port) as host:
        host.say_state(online=True, timestamp=1000)
        async with edge_node(outbox, tmp_path, dead, mosquitto.port, primary_host="scada"):
            await born(host)
    assert [record.getMessage() for record in caplog.records if record.levelno >= NOTICE] == [
        f"Sparkplug broker 127.0.0.1:{dead} is away: nothing listens there; trying again until one is there",
        f"Sparkplug is connected to broker 127.0.0.1:{mosquitto.port}",
    ]


async def test_tck_id_operational_behavior_edge_node_termination_host_offline(
    mosquitto, outbox, tmp_path
) -> None:
    """The host leaves: death, connection given up, births when it is back; an older word changes nothing."""
    async with Host(mosquitto.port) as host:
        host.say_state(online=True, timestamp=1000)
        async with edge_node(outbox, tmp_path, mosquitto.port, primary_host="scada") as edge:
            await born(host)
            host.say_state(online=False, timestamp=999)
            await eventually(lambda: edge.counters.states_refused == 1, "the old word is left alone")
            assert not host.of("NDEATH")
            host.say_state(online=False, timestamp=1000)
            await eventually(lambda: host.of("NDEATH"), "the node dies")
            await eventually(lambda: edge.counters.connections == 2, "it connects again")
            assert len(host.of("NBIRTH")) == 1
            host.say_state(online=True, timestamp=2000)
            await born(host, 2)
        assert [message.value("bdSeq") for message in host.of("NBIRTH")] == [0, 1]
        assert host.of("NDEATH")[0].value("bdSeq") == 0


async def test_tck_id_operational_behavior_primary_application_state_with_multiple_servers_walk(
    tmp_path, outbox
) -> None:
    """The node goes to the broker at which the host is, and is never at two at a time."""
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
    with running_mosquitto(folders[0]) as first, running_mosquitto(folders[1]) as second:
        async with Host(first.port) as here, Host(second.port) as there:
            here.say_state(online=True, timestamp=1000)
            there.say_state(online=False, timestamp=1000)
            async with edge_node(outbox, tmp_path, second.port, first.port, primary_host="scada"):
                await born(here)
                assert not there.messages
                there.say_state(online=True, timestamp=2000)
                here.say_state(online=False, timestamp=2000)
                await born(there)
                assert [message.kind for message in here.messages][-1] == "NDEATH"


async def test_tck_id_operational_behavior_edge_node_intentional_disconnect_ndeath(
    mosquitto, outbox, tmp_path
) -> None:
    async with Host(mosquitto.port) as host:
        async with edge_node(outbox, tmp_path, mosquitto.port):
            await born(host)
        await eventually(lambda: "Received DISCONNECT from edge-1-sparkplug" in mosquitto.log_text, "the end")
        await eventually(lambda: host.of("NDEATH"), "the host hears of the death")
        assert [message.kind for message in host.messages] == ["NBIRTH", "DBIRTH", "NDEATH"]
        said_last = mosquitto.log_text.rindex("NDEATH/edge-1'")
        assert said_last < mosquitto.log_text.index("Received DISCONNECT from edge-1-sparkplug")


async def test_a_memory_that_cannot_be_read_begins_anew(mosquitto, outbox, tmp_path, caplog) -> None:
    (tmp_path / "sparkplug.json").write_text('{"bd_seq": 999}')
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        assert host.of("NBIRTH")[0].value("bdSeq") == 0
    assert "cannot be read" in caplog.text
