"""The order of births, data and deaths, without a broker."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from support.sparkplug_host import seen

from daqsvc.publish.sparkplug.codec import DataType, Metric, PayloadError
from daqsvc.publish.sparkplug.host import PrimaryHost
from daqsvc.publish.sparkplug.memory import Memory
from daqsvc.publish.sparkplug.node import EdgeNode, OrderError


def number(name: str, value: int = 1) -> Metric:
    return Metric(name=name, timestamp_ms=1, datatype=DataType.INT64, value=value)


class Session(RuleBasedStateMachine):
    """Whatever the service does in whatever order, a host sees a sequence that the specification allows."""

    def __init__(self) -> None:
        super().__init__()
        self.node = EdgeNode("g", "e")
        self.expected = 0
        self.births: dict[str | None, dict[int, str]] = {}
        self.aliases: dict[tuple[str | None, str], int] = {}

    def see(self, publication) -> None:
        message = seen(publication.topic, publication.payload, publication.qos, retain=False)
        assert message.qos == 0
        owner = message.device
        if message.kind == "NBIRTH":
            self.births = {}
            assert message.seq == 0
            assert message.value("bdSeq") == 7
        else:
            assert None in self.births, "something comes before the node's birth"
            assert message.seq == self.expected
        self.expected = (message.seq + 1) % 256
        if message.kind in {"NBIRTH", "DBIRTH"}:
            self.births[owner] = {m.alias: m.name for m in message.metrics if m.alias is not None}
            for alias, name in self.births[owner].items():
                assert self.aliases.setdefault((owner, name), alias) == alias, "an alias has changed"
        elif message.kind == "DDEATH":
            del self.births[owner]
        else:
            assert owner in self.births, "data of what is not born"
            assert {m.alias for m in message.metrics} <= set(self.births[owner])
            assert all(m.name is None and m.datatype is None for m in message.metrics)

    @rule(devices=st.sets(st.sampled_from(["a", "b"])), names=st.sets(st.sampled_from("xyz"), min_size=1))
    def be_born(self, devices, names) -> None:
        metrics = [number(name) for name in sorted(names)]
        for publication in self.node.births(7, 1, metrics, dict.fromkeys(sorted(devices), metrics)):
            self.see(publication)

    @precondition(lambda self: self.node.is_born)
    @rule(device=st.sampled_from("ab"), names=st.sets(st.sampled_from("xyz"), min_size=1))
    def device_comes(self, device, names) -> None:
        self.see(self.node.device_birth(device, 1, [number(name) for name in sorted(names)]))

    @rule(device=st.sampled_from("ab"))
    def device_goes(self, device) -> None:
        if self.node.lives(device):
            self.see(self.node.device_death(device, 1))
        else:
            with pytest.raises(OrderError):
                self.node.device_death(device, 1)

    @rule(
        owner=st.sampled_from([None, "a", "b"]), name=st.sampled_from("xyz"), times=st.sampled_from([1, 300])
    )
    def something_changes(self, owner, name, times) -> None:
        for value in range(times):
            if self.node.knows(owner, [number(name)]):
                self.see(self.node.data(owner, 1, [number(name, value)]))
            else:
                with pytest.raises(OrderError):
                    self.node.data(owner, 1, [number(name)])

    @rule()
    def session_ends(self) -> None:
        self.node.die()
        self.births = {}

    @invariant()
    def aliases_are_unique(self) -> None:
        assert len(set(self.aliases.values())) == len(self.aliases)


TestSession = Session.TestCase


@pytest.mark.parametrize("name", ["", "a/b", "a+", "#"])
def test_an_id_that_a_topic_cannot_hold_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="Sparkplug"):
        EdgeNode("g", name)
    with pytest.raises(ValueError, match="Sparkplug"):
        EdgeNode(name, "e")


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), max_size=20))
def test_a_host_stands_as_its_newest_word_says(words) -> None:
    host = PrimaryHost("scada")
    newest, online = -1, None
    for sent, is_online in words:
        taken = host.take(
            host.topics[0], f'{{"online": {str(is_online).lower()}, "timestamp": {sent}}}'.encode()
        )
        assert taken == (sent >= newest)
        if taken:
            newest, online = sent, is_online
        assert host.online is online


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"ONLINE",
        b"[]",
        b"1",
        b'{"online": true}',
        b'{"online": 1, "timestamp": 1}',
        b'{"online": true, "timestamp": "1"}',
        b'{"online": true, "timestamp": true}',
        b"\xff",
        b"[" * 5000,
    ],
)
def test_what_is_no_state_is_refused_and_changes_nothing(payload: bytes) -> None:
    host = PrimaryHost("scada")
    host.take(host.topics[0], b'{"online": true, "timestamp": 5}')
    with pytest.raises(PayloadError, match="scada"):
        host.take(host.topics[0], payload)
    assert host.online is True


def test_a_host_of_sparkplug_2_2_says_its_state_in_one_word() -> None:
    host = PrimaryHost("scada")
    assert host.topics == ("spBv1.0/STATE/scada", "STATE/scada")
    for word, online in ((b"ONLINE", True), (b"OFFLINE", False), (b"ONLINE", True)):
        assert host.take("STATE/scada", word)
        assert host.online is online
    for payload in (b"", b"online", b'{"online": false, "timestamp": 1}', b"OFFLINE\n", b"\xff"):
        with pytest.raises(PayloadError, match="neither ONLINE nor OFFLINE"):
            host.take("STATE/scada", payload)
    assert host.online is True
    assert host.take("spBv1.0/STATE/scada", b'{"online": false, "timestamp": 0}')
    assert not host.take("STATE/scada", b"ONLINE"), "what a host tells as of 3.0 has a time, and counts"
    assert host.online is False


def test_a_disk_that_takes_no_writes_keeps_no_session_from_going_on(tmp_path, caplog) -> None:
    memory = Memory(tmp_path / "nowhere" / "sparkplug.json")
    memory.load()
    memory.begin_session(17)
    memory.advance(18)
    memory.advance(19)
    assert (memory.bd_seq, memory.cursor) == (1, 19)
    assert [record.getMessage().count("cannot be written") for record in caplog.records] == [1], "said once"
    (tmp_path / "nowhere").mkdir()
    memory.advance(20)
    again = Memory(tmp_path / "nowhere" / "sparkplug.json")
    again.load()
    assert (again.bd_seq, again.cursor) == (1, 20)


def test_the_number_of_a_session_goes_round_and_is_remembered(tmp_path) -> None:
    memory = Memory(tmp_path / "sparkplug.json")
    memory.load()
    for session in range(300):
        assert memory.bd_seq == session % 256
        memory.begin_session(17)
        memory.advance(17 + session)
        again = Memory(tmp_path / "sparkplug.json")
        again.load()
        assert (
            (again.bd_seq, again.cursor)
            == (memory.bd_seq, memory.cursor)
            == ((session + 1) % 256, 17 + session)
        )
