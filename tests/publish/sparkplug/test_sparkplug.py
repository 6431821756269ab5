"""Births, figures and commands of the edge node, against a real broker and a host that reads for itself.

Tests that check a rule of the Sparkplug 3.0 specification carry its assertion id, ``tck-id-...``, with
underscores.
"""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from support.sparkplug_edge import (
    BOOLEAN,
    DOUBLE,
    NODE,
    REBIRTH,
    STATE,
    STRING,
    Machine,
    born,
    edge_node,
    rebirth,
    said,
)
from support.sparkplug_host import Host, seen
from support.waiting import eventually

from daqsvc.publish.sparkplug.codec import DataType, Metric, Payload, encode

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]


async def test_tck_id_message_flow_edge_node_birth_publish_nbirth_topic(mosquitto, outbox, tmp_path) -> None:
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        assert host.messages[0].topic == NODE.format("NBIRTH")
        assert host.of("DBIRTH")[0].topic == NODE.format("DBIRTH") + "/rig"


async def test_tck_id_principles_birth_certificates_order(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    await machine.flips(3)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port) as edge:
        edge.report(said("F1"))
        await born(host)
        await machine.says("F9")
        await eventually(lambda: host.told(STATE, historical=False), "the alarm is told")
        assert [message.kind for message in host.messages][:2] == ["NBIRTH", "DBIRTH"]


@pytest.mark.long
async def test_tck_id_payloads_nbirth_seq_and_every_later_number(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        await machine.flips(150)
        await eventually(lambda: len(host.of("NDATA")) >= 300, "all alarms are told")
        numbers = [message.seq for message in host.messages]
        assert numbers == [number % 256 for number in range(len(numbers))]


async def test_tck_id_payloads_nbirth_qos_and_retain(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        await machine.says("F1")
        await eventually(lambda: host.of("NDATA"), "the alarm is told")
        for message in host.messages:
            assert (message.qos, message.retain) == (0, False), message.kind


async def test_tck_id_payloads_nbirth_timestamp_in_utc(mosquitto, outbox, tmp_path) -> None:
    before_ms = time.time_ns() // 1_000_000
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        after_ms = time.time_ns() // 1_000_000
        for message in host.of("NBIRTH", "DBIRTH"):
            assert before_ms <= message.timestamp <= after_ms
            assert all(metric.timestamp is not None for metric in message.metrics)


async def test_tck_id_operational_behavior_data_commands_rebirth_name(mosquitto, outbox, tmp_path) -> None:
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        control = host.of("NBIRTH")[0].metric(REBIRTH)
        assert (control.datatype, control.value, control.alias) == (BOOLEAN, False, None)


async def test_tck_id_payloads_metric_datatype_req_and_not_req(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        await machine.says("F1")
        await eventually(lambda: host.of("NDATA"), "the alarm is told")
        assert all(m.datatype in range(1, 35) for b in host.of("NBIRTH", "DBIRTH") for m in b.metrics)
        assert all(m.datatype is None for b in host.of("NDATA") for m in b.metrics)


async def test_tck_id_payloads_alias_birth_requirement_and_uniqueness(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox, ("rotor-fault", "unheard-of"))
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
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


async def test_tck_id_operational_behavior_data_publish_nbirth_values(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    await machine.says("F1")
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port) as edge:
        edge.report(said("F1", speed=612.5))
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


async def test_tck_id_operational_behavior_data_publish_dbirth_change(mosquitto, outbox, tmp_path) -> None:
    """Figures are told when they change, and only then."""
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port) as edge:
        edge.report(said("F1", speed=600.0))
        await eventually(lambda: 600.0 in _speeds(host), "the first speed")
        edge.report(said("F1", speed=601.0))
        await eventually(lambda: 601.0 in _speeds(host), "the second speed")
        last = [message for message in host.of("DDATA") if len(message.metrics) == 1]
        assert [metric.value for metric in last[-1].metrics] == [601.0]
        assert edge.counters.data == len(host.of("DDATA"))


async def test_tck_id_operational_behavior_data_commands_rebirth_action(mosquitto, outbox, tmp_path) -> None:
    """New births with the same bdSeq, the sequence anew, and no death."""
    machine = Machine(outbox)
    await machine.says("F1")
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        host.ask(NODE.format("NCMD"), rebirth())
        await born(host, 2)
        first, second = host.of("NBIRTH")
        assert second.seq == 0
        assert second.value("bdSeq") == first.value("bdSeq")
        assert {m.name: m.alias for m in second.metrics} == {m.name: m.alias for m in first.metrics}
        assert [message.kind for message in host.messages][-2:] == ["NBIRTH", "DBIRTH"]
        assert not host.of("NDEATH")


async def test_what_is_no_rebirth_is_counted_and_changes_nothing(mosquitto, outbox, tmp_path) -> None:
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port) as edge:
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


async def test_a_shelved_alarm_still_says_that_its_condition_stands(mosquitto, outbox, tmp_path) -> None:
    machine = Machine(outbox)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port):
        await born(host)
        await machine.says("F1")
        await machine.shelves()
        await eventually(lambda: "shelved" in host.told(STATE, historical=False), "it is shelved")
        assert host.told("Alarms/rig/rotor-fault/Active", historical=False) == [True]


async def test_tck_id_operational_behavior_device_ddeath(mosquitto, outbox, tmp_path) -> None:
    """The machine is out of reach: it dies, alarms are told all the same, and it is born again."""
    machine = Machine(outbox)
    async with Host(mosquitto.port) as host, edge_node(outbox, tmp_path, mosquitto.port) as edge:
        await born(host)
        edge.status({"buses": {"can0": {"up": 0}}})
        await eventually(lambda: host.of("DDEATH"), "the device dies")
        assert host.of("DDEATH")[0].seq == 2
        edge.report(said("F1"))
        await machine.says("F1")
        await eventually(lambda: host.of("NDATA"), "the alarm is told")
        assert not host.of("DDATA")
        assert len(host.of("DBIRTH")) == 1
        edge.status({"buses": {"can0": {"up": 1}}})
        await born(host, 2)
        assert host.of("DBIRTH")[1].value("bank/Decision") == "F1"


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
