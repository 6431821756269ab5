"""The edge node against a real broker and a host that reads for itself.

Tests that check a rule of the Sparkplug 3.0 specification carry its assertion id, ``tck-id-...``, with
underscores.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import replace

import pytest
from brokers import LOOPBACK, Mosquitto, TcpProxy, eventually, free_port, running_mosquitto
from sparkplug_host import Host, seen

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.store import Outbox
from daqsvc.publish.mqtt import MqttSettings
from daqsvc.publish.payloads import alarm_payload
from daqsvc.publish.settings import Reading
from daqsvc.publish.sparkplug.codec import DataType, Metric, Payload, encode
from daqsvc.publish.sparkplug.edge import SparkplugEdge
from daqsvc.publish.sparkplug.settings import Server, SparkplugSettings
from daqsvc.publish.topics import Topics

pytestmark = pytest.mark.mosquitto

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


def said(decision: str, severity: str = "alert", speed: float = 600.0) -> Diagnosis:
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


class Machine:
    """Alarms into the outbox, as the service puts them there."""

    def __init__(self, outbox: Outbox, alarms: tuple[str, ...] = ("rotor-fault",)) -> None:
        self._outbox = outbox
        self._manager = AlarmManager(
            Identity("lab", "edge-1", "rig"), [DiagnosisRule(name, "bank") for name in alarms], CLOCK
        )

    async def says(self, decision: str, severity: str = "alert") -> None:
        await self._tell(self._manager.take(said(decision, severity)))

    async def shelves(self) -> None:
        command = AlarmCommand(verb=Verb.SHELVE, alarm="rotor-fault", by="me", duration_s=60.0)
        await self._tell(self._manager.obey(command))

    async def _tell(self, events) -> None:
        for event in events:
            topic = TOPICS.alarm("rig", event.alarm)
            await self._outbox.append(
                topic, lambda sequence, event=event: alarm_payload(event, sequence).to_json(), retain=True
            )

    async def flips(self, times: int) -> None:
        """Raise and return the alarm, so often; two events each time."""
        for number in range(times):
            await self.says(f"F{number}")
            await self.says("N", "normal")


@pytest.fixture
async def outbox(tmp_path):
    box = Outbox(tmp_path / "outbox.sqlite", CLOCK)
    await box.open()
    yield box
    await box.close()


@pytest.fixture
def broker(tmp_path):
    with running_mosquitto(tmp_path) as mosquitto:
        yield mosquitto


@contextlib.asynccontextmanager
async def edge_node(outbox, tmp_path, *ports, primary_host=None, protocol="5"):
    settings = SparkplugSettings(
        group="lab",
        edge_node="edge-1",
        device="rig",
        machine="rig",
        servers=tuple(Server(LOOPBACK, port, tls=False) for port in ports),
        client_id="edge-1-sparkplug",
        memory=tmp_path / "sparkplug.json",
        primary_host=primary_host,
        alarms=("rotor-fault",),
        readings=READINGS,
    )
    mqtt = MqttSettings(LOOPBACK, ports[0], "edge-1", protocol=protocol)
    edge = SparkplugEdge(settings, mqtt, outbox, TOPICS, CLOCK)
    running = asyncio.create_task(edge.run())
    try:
        yield edge
    finally:
        await edge.stop(5.0)
        await running


def rebirth(*, value: object = True, name: str = REBIRTH, datatype: DataType = DataType.BOOLEAN) -> bytes:
    return encode(Payload(1, None, (Metric(name=name, timestamp_ms=1, datatype=datatype, value=value),)))


async def born(host: Host, times: int = 1) -> None:
    await eventually(lambda: len(host.of("DBIRTH")) >= times, f"birth number {times}")


async def test_tck_id_message_flow_edge_node_birth_publish_nbirth_topic(broker, outbox, tmp_path) -> None:
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        assert host.messages[0].topic == NODE.format("NBIRTH")
        assert host.of("DBIRTH")[0].topic == NODE.format("DBIRTH") + "/rig"


async def test_tck_id_principles_birth_certificates_order(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    await machine.flips(3)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port) as edge:
        edge.observe(said("F1"))
        await born(host)
        await machine.says("F9")
        await eventually(lambda: host.told(STATE, historical=False), "the alarm is told")
        assert [message.kind for message in host.messages][:2] == ["NBIRTH", "DBIRTH"]


async def test_tck_id_payloads_nbirth_seq_and_every_later_number(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        await machine.flips(150)
        await eventually(lambda: len(host.of("NDATA")) >= 300, "all alarms are told")
        numbers = [message.seq for message in host.messages]
        assert numbers == [number % 256 for number in range(len(numbers))]


async def test_tck_id_payloads_nbirth_qos_and_retain(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        await machine.says("F1")
        await eventually(lambda: host.of("NDATA"), "the alarm is told")
        for message in host.messages:
            assert (message.qos, message.retain) == (0, False), message.kind


async def test_tck_id_payloads_nbirth_timestamp_in_utc(broker, outbox, tmp_path) -> None:
    before_ms = time.time_ns() // 1_000_000
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        after_ms = time.time_ns() // 1_000_000
        for message in host.of("NBIRTH", "DBIRTH"):
            assert before_ms <= message.timestamp <= after_ms
            assert all(metric.timestamp is not None for metric in message.metrics)


async def test_tck_id_operational_behavior_data_commands_rebirth_name(broker, outbox, tmp_path) -> None:
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        control = host.of("NBIRTH")[0].metric(REBIRTH)
        assert (control.datatype, control.value, control.alias) == (BOOLEAN, False, None)


async def test_tck_id_payloads_metric_datatype_req_and_not_req(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        await machine.says("F1")
        await eventually(lambda: host.of("NDATA"), "the alarm is told")
        assert all(m.datatype in range(1, 35) for b in host.of("NBIRTH", "DBIRTH") for m in b.metrics)
        assert all(m.datatype is None for b in host.of("NDATA") for m in b.metrics)


async def test_tck_id_payloads_alias_birth_requirement_and_uniqueness(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox, ("rotor-fault", "unheard-of"))
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        await machine.says("F1")
        await eventually(lambda: len(host.of("NBIRTH")) > 1, "the new alarm leads to a birth")
        assert host.of("NBIRTH")[1].value("Alarms/rig/unheard-of/Active") is True
        await machine.says("N", "normal")
        await eventually(lambda: len(host.of("NDATA")) == 3, "the returns are told")
        last = host.of("NBIRTH")[-1].metrics + host.of("DBIRTH")[-1].metrics
        aliases = [metric.alias for metric in last if metric.alias is not None]
        assert len(set(aliases)) == len(aliases) == len(last) - 2  # bdSeq and Rebirth go by their names
        assert all(m.name is None and m.alias in aliases for b in host.of("NDATA") for m in b.metrics)


async def test_tck_id_operational_behavior_data_publish_nbirth_values(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    await machine.says("F1")
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port) as edge:
        edge.observe(said("F1", speed=612.5))
        await born(host)
        birth = host.of("NBIRTH")[0]
        assert birth.value(STATE) == "active_unacknowledged"
        assert birth.value("Alarms/rig/rotor-fault/Active") is True
        assert birth.value("Alarms/rig/rotor-fault/Acknowledged") is False
        assert birth.value("Alarms/rig/rotor-fault/Level") == 1
        assert birth.value("Properties/Site") == "lab"
        await eventually(lambda: 612.5 in _speeds(host), "the speed is told")
        device = host.of("DBIRTH")[0]
        assert device.metric("bank/speed").datatype == DOUBLE
        assert device.metric("bank/speed").properties == {"engUnit": "rpm"}
        assert device.metric("bank/Decision").datatype == STRING
        for metric in [*birth.metrics, *device.metrics]:
            assert metric.null == (metric.value is None)


def _speeds(host: Host) -> list[float]:
    return [message.value("bank/speed") for message in host.of("DBIRTH")] + host.told(
        "bank/speed", historical=False
    )


async def test_tck_id_operational_behavior_data_publish_dbirth_change(broker, outbox, tmp_path) -> None:
    """Figures are told when they change, and only then."""
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port) as edge:
        edge.observe(said("F1", speed=600.0))
        await eventually(lambda: 600.0 in _speeds(host), "the first speed")
        edge.observe(said("F1", speed=601.0))
        await eventually(lambda: 601.0 in _speeds(host), "the second speed")
        last = [message for message in host.of("DDATA") if len(message.metrics) == 1]
        assert [metric.value for metric in last[-1].metrics] == [601.0]
        assert edge.counters.data == len(host.of("DDATA"))


async def test_tck_id_topics_nbirth_bdseq_matching(broker, outbox, tmp_path) -> None:
    """The will of each session carries the number of its birth, and the next session has the next number."""
    async with TcpProxy(broker.port) as proxy, Host(broker.port) as host:
        async with edge_node(outbox, tmp_path, proxy.port):
            await born(host)
            proxy.cut()
            await born(host, 2)
        await eventually(lambda: len(host.of("NDEATH")) == 2, "both sessions have died")
        births = [message.metric("bdSeq") for message in host.of("NBIRTH")]
        deaths = [message.metric("bdSeq") for message in host.of("NDEATH")]
        assert [(metric.value, metric.datatype) for metric in births] == [(0, INT64), (1, INT64)]
        assert [metric.value for metric in deaths] == [0, 1]


async def test_tck_id_payloads_ndeath_will_message(broker, outbox, tmp_path) -> None:
    async with (
        TcpProxy(broker.port) as proxy,
        Host(broker.port) as host,
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


async def test_tck_id_topics_nbirth_bdseq_increment_over_failed_connects(broker, outbox, tmp_path) -> None:
    """Only sessions count: connections that never came about use no number up, a restart forgets none."""
    async with Host(broker.port) as host:
        async with edge_node(outbox, tmp_path, broker.port):
            await born(host)
        async with edge_node(outbox, tmp_path, free_port()) as away:
            await eventually(lambda: away._backoff._ceiling_ns > 6e9, "several connections have failed")
        async with edge_node(outbox, tmp_path, broker.port):
            await born(host, 2)
        assert [message.value("bdSeq") for message in host.of("NBIRTH")] == [0, 1]


async def test_tck_id_message_flow_edge_node_ncmd_subscribe(broker, outbox, tmp_path) -> None:
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        log = broker.log_text
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


async def test_tck_id_operational_behavior_data_commands_rebirth_action(broker, outbox, tmp_path) -> None:
    """New births with the same bdSeq, the sequence anew, and no death."""
    machine = Machine(outbox)
    await machine.says("F1")
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        host.ask(NODE.format("NCMD"), rebirth())
        await born(host, 2)
        first, second = host.of("NBIRTH")
        assert second.seq == 0
        assert second.value("bdSeq") == first.value("bdSeq")
        assert {m.name: m.alias for m in second.metrics} == {m.name: m.alias for m in first.metrics}
        assert [message.kind for message in host.messages][-2:] == ["NBIRTH", "DBIRTH"]
        assert not host.of("NDEATH")


async def test_what_is_no_rebirth_is_counted_and_changes_nothing(broker, outbox, tmp_path) -> None:
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port) as edge:
        await born(host)
        before = len(host.messages)
        refused = [
            b"",
            b"\xff\xff",
            b"{}",
            rebirth(name="Node Control/Reboot"),
            rebirth(value=1, datatype=DataType.INT32),
            encode(Payload(1, None, (Metric(name=REBIRTH, datatype=DataType.BOOLEAN, value=None),))),
        ]
        for payload in refused:
            host.ask(NODE.format("NCMD"), payload)
        host.ask(NODE.format("DCMD") + "/rig", rebirth())
        await eventually(lambda: edge.counters.commands_refused == len(refused) + 1, "all are refused")
        host.ask(NODE.format("NCMD"), rebirth(value=False))
        host.ask(NODE.format("NCMD"), rebirth())
        await born(host, 2)
        assert len(host.messages) == before + 2


async def test_tck_id_message_flow_edge_node_birth_publish_phid_wait(broker, outbox, tmp_path) -> None:
    async with Host(broker.port) as host:
        host.say_state(online=False, timestamp=1000)
        async with edge_node(outbox, tmp_path, broker.port, primary_host="scada") as edge:
            await eventually(lambda: "STATE/scada (QoS 1)" in broker.log_text, "the node listens")
            host.say_state(online=True, timestamp=999)
            await eventually(lambda: edge.counters.states_refused == 1, "the old word is left alone")
            assert not host.messages
            host.say_state(online=True, timestamp=1001)
            await born(host)


async def test_tck_id_operational_behavior_edge_node_termination_host_offline(
    broker, outbox, tmp_path
) -> None:
    """The host leaves: death, connection given up, births when it is back; an older word changes nothing."""
    async with Host(broker.port) as host:
        host.say_state(online=True, timestamp=1000)
        async with edge_node(outbox, tmp_path, broker.port, primary_host="scada") as edge:
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
    broker, outbox, tmp_path
) -> None:
    async with Host(broker.port) as host:
        async with edge_node(outbox, tmp_path, broker.port):
            await born(host)
        await eventually(lambda: "Received DISCONNECT from edge-1-sparkplug" in broker.log_text, "the end")
        assert [message.kind for message in host.messages] == ["NBIRTH", "DBIRTH", "NDEATH"]
        said_last = broker.log_text.rindex("NDEATH/edge-1'")
        assert said_last < broker.log_text.index("Received DISCONNECT from edge-1-sparkplug")


async def test_a_shelved_alarm_still_says_that_its_condition_stands(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        await machine.says("F1")
        await machine.shelves()
        await eventually(lambda: "shelved" in host.told(STATE, historical=False), "it is shelved")
        assert host.told("Alarms/rig/rotor-fault/Active", historical=False) == [True]


async def test_tck_id_operational_behavior_device_ddeath(broker, outbox, tmp_path) -> None:
    """The machine is out of reach: it dies, alarms are told all the same, and it is born again."""
    machine = Machine(outbox)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port) as edge:
        await born(host)
        edge.reach(there=False)
        await eventually(lambda: host.of("DDEATH"), "the device dies")
        assert host.of("DDEATH")[0].seq == 2
        edge.observe(said("F1"))
        await machine.says("F1")
        await eventually(lambda: host.of("NDATA"), "the alarm is told")
        assert not host.of("DDATA")
        assert len(host.of("DBIRTH")) == 1
        edge.reach(there=True)
        await born(host, 2)
        assert host.of("DBIRTH")[1].value("bank/Decision") == "F1"


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


async def test_history_is_not_told_twice_after_a_restart(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(broker.port) as host:
        async with edge_node(outbox, tmp_path, broker.port):
            await born(host)
            await machine.flips(5)
            await eventually(lambda: len(host.told(EVENT, historical=False)) == 10, "all are told")
        async with edge_node(outbox, tmp_path, broker.port) as edge:
            await born(host, 2)
            await machine.says("F9")
            await eventually(lambda: edge.counters.alarms == 1, "the next one is told")
            assert edge.counters.historical == 0


async def test_a_box_that_begins_with_sparkplug_tells_no_history_of_before(broker, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    await machine.flips(5)
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port) as edge:
        await born(host)
        await machine.says("F9")
        await eventually(lambda: edge.counters.alarms == 1, "the next one is told")
        assert edge.counters.historical == 0


async def test_a_memory_that_cannot_be_read_begins_anew(broker, outbox, tmp_path, caplog) -> None:
    (tmp_path / "sparkplug.json").write_text('{"bd_seq": 999}')
    async with Host(broker.port) as host, edge_node(outbox, tmp_path, broker.port):
        await born(host)
        assert host.of("NBIRTH")[0].value("bdSeq") == 0
    assert "cannot be read" in caplog.text


def test_the_host_of_these_tests_reads_for_itself() -> None:
    """Bytes written by hand after the specification's field numbers; nothing of the edge node is in them."""
    metric = b"\x0a\x01a\x10\x05\x18\x07\x20\x04\x28\x01\x58\x2a"
    message = seen(
        "spBv1.0/g/NDATA/e", b"\x08\x09\x12" + bytes([len(metric)]) + metric + b"\x18\x03", 0, retain=False
    )
    told = message.metrics[0]
    assert (message.timestamp, message.seq) == (9, 3)
    assert (told.name, told.alias, told.timestamp, told.datatype, told.historical, told.value) == (
        "a",
        5,
        7,
        4,
        True,
        42,
    )
    assert replace(told, null=False) == told
