"""A disk that takes no alarms while the broker does: they arrive, that is said, and it is told later."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import textwrap
from collections import Counter

import pytest
from support.alarm_desk import alarm_service
from support.brokers import Consumer, running_mosquitto
from support.mqtt_publishing import mqtt, outputs
from support.ports import free_port
from support.small_disks import failing, mounted
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox import writer
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.reading import read_journal

pytestmark = pytest.mark.integration
CLOCK = SystemClock()
ALARMS = ("rotor-fault", "bearing-fault", "race-fault")
RULES = [DiagnosisRule(alarm, alarm, latching=alarm == "race-fault") for alarm in ALARMS]
LIMITS = OutboxLimits(reserve_bytes=0, ballast_bytes=0, alarms_waiting_max=300)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(writer, "RETRY_MOST_S", 0.1)


@pytest.fixture
def disk(tmp_path):
    with mounted(tmp_path / "disk", "4m") as small:
        yield small


@contextlib.asynccontextmanager
async def desk_at(store, port, *, stop_s=20.0):
    """The alarms of a service with a broker, from its start to its stop."""
    desk = alarm_service(
        Identity("lab", "edge-1", "rig"), RULES, store, CLOCK, outputs(mqtt(port)), limits=LIMITS
    )
    await desk.open()
    await desk.resume({})
    running = [asyncio.create_task(teller.run()) for teller in desk.outputs.values()]
    try:
        yield desk
    finally:
        await desk.settle(0.3)
        await desk.stop(stop_s)
        await asyncio.gather(*running)
        await desk.close(2.0)


def find(desk, alarm, severity, times=1):
    for _ in range(times):
        desk.take(Diagnosis("rig", alarm, CLOCK.monotonic_ns(), "shaft", 0, 64, "F1", severity=severity))


def many(desk, count):
    """So many events of one thing, one after the other."""
    for _ in range(count):
        done = desk.outbox.submit(f"{desk.topics.base}/rig/many", _one_of_many, retain=True)
        done.add_done_callback(lambda done: done.exception())


def _one_of_many(sequence):
    told = {"id": f"many-{sequence}", "sequence": sequence, "alarm": "many", "state": sequence, "level": ""}
    return json.dumps(told).encode()


def states(messages):
    """By alarm what the last message says: state and level."""
    return {m.payload["alarm"]: (m.payload["state"], m.payload["level"]) for m in messages}


def shown(desk):
    return {name: (alarm.state.value, alarm.level.label) for name, alarm in desk.manager.alarms.items()}


def told_as_shown(consumer, desk, alarms=ALARMS):
    """Whether the broker shows how these alarms stand."""
    told = states(consumer.on("/alarms/"))
    return all(told.get(alarm) == shown(desk)[alarm] for alarm in alarms)


def each_id_means_one_event(messages):
    payloads = {}
    for message in messages:
        assert payloads.setdefault(message.payload["id"], message.payload) == message.payload
    assert max(Counter(one["sequence"] for one in payloads.values()).values()) == 1
    return payloads


async def in_journal(desk):
    """By id what the journal has, and whether it is marked as sent."""
    view = await asyncio.to_thread(read_journal, desk.outbox.directory, history=10**6)
    return {json.loads(entry.payload)["id"]: entry.sent for entry in view.history}


def journal_alarm(desk):
    return desk.manager.alarms["store/journal"]


async def test_alarms_reach_the_broker_from_a_full_disk_and_the_disk_later(disk, mosquitto, caplog):
    store = disk.directory / "store"
    async with Consumer(mosquitto.port) as consumer, desk_at(store, mosquitto.port) as desk:
        counters = desk.outbox.counters
        find(desk, "rotor-fault", "alert")
        await eventually(lambda: counters.depth == 0 and counters.sent == 1, "the broker has it")
        disk.fill()
        many(desk, 80)
        find(desk, "bearing-fault", "danger")
        await eventually(lambda: len(consumer.on("rig/")) >= 82, "all arrive, the disk being full")
        desk.tick()
        assert journal_alarm(desk).state.is_active
        assert "is not backed by the disk" in caplog.text
        await eventually(lambda: consumer.on("store/journal"), "and that they are not on the disk is told")
        assert "not backed by the disk" in consumer.on("store/journal")[0].payload["message"]
        await eventually(lambda: counters.sent_unbacked == counters.waiting > 80, "the broker has them")
        assert counters.unbacked == 1
        assert counters.lost == counters.refused == counters.unjournalled == 0
        numbers = [message.payload["sequence"] for message in consumer.on("rig/")]
        assert numbers == sorted(set(numbers)), "in order, and each once"
        disk.free()
        await eventually(
            lambda: not (counters.waiting or counters.depth or counters.unbacked), "the disk takes them"
        )
        there = await in_journal(desk)
        assert set(there) >= set(each_id_means_one_event(consumer.on("rig/")))
        assert all(there.values()), "the broker has them, and the journal knows"
        desk.tick()
        await eventually(lambda: not journal_alarm(desk).state.is_active, "it is over")
    async with desk_at(store, mosquitto.port) as desk:
        assert shown(desk)["bearing-fault"] == ("active_unacknowledged", "danger")
        assert desk.manager.alarms["rotor-fault"].level.label == "alert"
        assert not desk.outbox.broker_is_ahead


async def test_a_stop_on_a_full_disk_hands_everything_over(disk, mosquitto, caplog):
    """What waits in memory goes to the broker before the process ends; what the journal lacks is said."""
    store = disk.directory / "store"
    async with Consumer(mosquitto.port) as consumer:
        async with desk_at(store, mosquitto.port) as desk:
            await eventually(lambda: desk.outputs["mqtt"].counters.connected, "there is a broker")
            await desk.outbox.pending(0, 1)
            disk.fill()
            find(desk, "race-fault", "danger")
            await eventually(lambda: desk.outbox.counters.unbacked, "the disk is full")
            many(desk, 200)
            find(desk, "bearing-fault", "danger")
        await eventually(lambda: len(consumer.on("rig/")) >= 202, "all have arrived")
        counters = desk.outbox.counters
        assert counters.lost == 0
        assert counters.unjournalled + counters.appended >= 202
        assert "will never have" in caplog.text
        disk.free()
        async with desk_at(store, mosquitto.port) as desk:
            await eventually(lambda: not desk.outbox.counters.depth, "all are told anew")
            await eventually(lambda desk=desk: told_as_shown(consumer, desk), "the broker is put right")
        each_id_means_one_event(consumer.on("rig/"))


async def test_without_a_broker_what_is_lost_at_the_stop_is_said_with_number_and_topics(disk, caplog):
    async with desk_at(disk.directory / "store", free_port(), stop_s=0.5) as desk:
        await desk.outbox.pending(0, 1)
        disk.fill()
        counters = desk.outbox.counters
        while not counters.unbacked:
            many(desk, 20)
            await asyncio.sleep(0.02)
        find(desk, "bearing-fault", "danger")
        many(desk, 300)
        await eventually(lambda: counters.refused, "more than can wait are refused")
        desk.tick()
        assert journal_alarm(desk).level.label == "danger", "alarms are being lost, and that is said"
    assert counters.lost == LIMITS.alarms_waiting_max
    said = [
        r.getMessage()
        for r in caplog.records
        if "which neither the disk nor the broker has" in r.getMessage()
    ]
    assert len(said) == 1
    assert f"lost {counters.lost} messages" in said[0]
    assert f"daqsvc/lab/edge-1/rig/many ({counters.lost - 1})" in said[0]
    assert "daqsvc/lab/edge-1/rig/alarms/bearing-fault (1)" in said[0]


async def test_a_broker_that_comes_late_gets_what_has_waited_and_the_newest_state_of_what_was_refused(
    disk, tmp_path
):
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(running_mosquitto(tmp_path))
        broker.stop()
        async with desk_at(disk.directory / "store", broker.port) as desk:
            await desk.outbox.pending(0, 1)
            disk.fill()
            find(desk, "rotor-fault", "danger")
            many(desk, 400)
            find(desk, "bearing-fault", "danger")
            await eventually(lambda: desk.outbox.counters.refused, "more than can wait are refused")
            broker.start()
            async with Consumer(broker.port) as consumer:
                await eventually(lambda: consumer.on("rotor-fault"), "the broker is back")

                def told():
                    desk.tick()
                    return told_as_shown(consumer, desk, ALARMS[:2])

                await eventually(told, "how each alarm stands is known, the disk still being full")
                disk.free()
                await eventually(lambda: not desk.outbox.counters.waiting, "the disk takes them")
                there = await in_journal(desk)
                told = each_id_means_one_event(consumer.on("rig/"))
                assert {one["alarm"] for name, one in told.items() if name not in there} <= {"many"}
                assert desk.outbox.counters.unjournalled == len(set(told) - set(there))


async def test_for_weeks_without_a_disk_the_memory_is_bounded(disk, mosquitto):
    store = disk.directory / "store"
    async with Consumer(mosquitto.port) as consumer, desk_at(store, mosquitto.port) as desk:
        counters = desk.outbox.counters
        find(desk, "bearing-fault", "danger")
        await eventually(lambda: counters.sent == 1, "the broker has it")
        disk.fill()
        for turn in range(1, 9):
            many(desk, 200)
            await eventually(lambda turn=turn: len(consumer.on("many")) == 200 * turn, "they arrive")
            await eventually(lambda turn=turn: counters.sent_unbacked == 200 * turn, "the broker has them")
        assert counters.waiting <= 90
        assert counters.unjournalled + counters.waiting == 1600
        assert counters.refused == 0
        disk.free()
        await eventually(lambda: not counters.waiting, "the disk takes what is left")
        assert counters.unjournalled >= 1510
        newest = consumer.on("many")[-1].payload
        assert newest["id"] in {json.loads(message.payload)["id"] for message in await desk.outbox.latest()}


async def test_a_disk_that_answers_with_errors_does_not_keep_alarms_from_the_broker(tmp_path, mosquitto):
    """Not even the marks can be written: the numbers of memory lie below all that come after them."""
    with failing(tmp_path) as broken:
        store = broken.directory / "store"
        async with Consumer(mosquitto.port) as consumer:
            async with desk_at(store, mosquitto.port) as desk:
                find(desk, "rotor-fault", "danger")
                await eventually(lambda: desk.outbox.counters.sent == 1, "the broker has it")
                broken.fail(2)
                for turn in range(1, 9):
                    many(desk, 200)
                    await eventually(lambda turn=turn: len(consumer.on("many")) == 200 * turn, "they arrive")
                    # Only then is there room in memory for as many again.
                    await eventually(lambda: desk.outbox.counters.waiting <= 90, "the broker has them")
                assert desk.outbox.counters.unbacked == 1
            before = each_id_means_one_event(consumer.on("rig/"))
            await asyncio.to_thread(broken.unmount)
            await asyncio.to_thread(broken.mount)
            async with desk_at(store, mosquitto.port) as desk:
                assert desk.outbox.counters.vanished == desk.outbox.counters.quarantined == 0
                find(desk, "race-fault", "danger")
                await eventually(lambda: consumer.on("race-fault"), "it goes on")
            after = each_id_means_one_event(consumer.on("rig/"))
            assert after[consumer.on("race-fault")[0].payload["id"]]["sequence"] > max(
                one["sequence"] for one in before.values()
            )


VICTIM = """
import asyncio, sys
from pathlib import Path
sys.path[:0] = sys.argv[3:]
from test_outbox_unbacked import desk_at, find, many

async def main():
    async with desk_at(Path(sys.argv[1]), int(sys.argv[2])) as desk:
        while True:
            line = await asyncio.to_thread(sys.stdin.readline)
            what, alarm = line.split()
            if what == "many":
                many(desk, 20)
                await asyncio.sleep(0.05)
            else:
                find(desk, alarm, what)
            print(desk.outbox.counters.unbacked, flush=True)

asyncio.run(main())
"""


async def test_after_kill_minus_nine_on_a_full_disk_the_broker_shows_the_truth_again(disk, mosquitto):
    store = disk.directory / "store"
    path = [part for part in sys.path if "tests" in part]
    victim = await asyncio.create_subprocess_exec(
        sys.executable, "-c", textwrap.dedent(VICTIM), str(store), str(mosquitto.port), *path,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip

    async def say(what, alarm):
        victim.stdin.write(f"{what} {alarm}\n".encode())
        return await victim.stdout.readline()

    async with Consumer(mosquitto.port) as consumer:
        try:
            await say("danger", "race-fault")
            await say("normal", "race-fault")  # and so it latches
            await say("danger", "rotor-fault")
            await eventually(lambda: consumer.on("rotor-fault"), "it is active, and on the disk")
            await asyncio.sleep(0.3)  # and the mark of that
            disk.fill()
            while not int(await say("many", "-")):
                pass  # the log had room left
            await say("normal", "rotor-fault")
            await say("danger", "bearing-fault")
            await eventually(
                lambda: states(consumer.on("rotor-fault"))["rotor-fault"][1] == "normal", "the return is told"
            )
            await eventually(lambda: consumer.on("bearing-fault"), "and what was never on the disk")
        finally:
            victim.kill()
            await victim.wait()
        for room in (False, True):
            if room:
                disk.free()
            async with desk_at(store, mosquitto.port) as desk:
                assert desk.outbox.broker_is_ahead or room, "the log may have had room for all of it before"
                assert desk.manager.alarms["race-fault"].state.is_latched
                assert shown(desk)["rotor-fault"][1] == "danger", "as far as the disk knows"
                await eventually(
                    lambda desk=desk: told_as_shown(consumer, desk), "the broker shows how they stand"
                )
                if room:
                    await eventually(lambda: not desk.outbox.broker_is_ahead, "it is told")
        each_id_means_one_event(consumer.on("rig/"))
        async with desk_at(store, mosquitto.port) as desk:
            assert not desk.outbox.broker_is_ahead


async def test_a_run_that_the_disk_never_heard_of_leaves_nothing_false_at_the_broker(disk, tmp_path):
    """It ends in order, or is killed; nothing on the disk says that it was, but the broker remembers."""
    store = disk.directory / "store"
    with running_mosquitto(tmp_path) as mosquitto:
        port = mosquitto.port
        async with desk_at(store, port) as desk:
            find(desk, "rotor-fault", "danger")
            desk.tick()
            await eventually(lambda: desk.outbox.counters.depth == 0, "the broker has it")
        disk.refuse_writes()
        async with desk_at(store, port) as desk, Consumer(port) as consumer:
            find(desk, "bearing-fault", "danger")
            await eventually(lambda: desk.outbox.counters.unbacked, "it is not backed")
            desk.tick()
            await eventually(lambda: consumer.on("store/journal"), "that is said")
            await eventually(lambda: consumer.on("bearing-fault"), "and so is the fault")
        disk.take_writes()
        async with Consumer(port) as consumer:
            await eventually(lambda: len(consumer.on("/alarms/")) == 3, "all that is retained")
            assert states(consumer.on("/alarms/"))["store/journal"][0].startswith("active")
            before = {m.topic: m.payload["sequence"] for m in consumer.on("/alarms/")}
            async with desk_at(store, port) as desk:
                for _ in range(3):
                    desk.tick()
                    await asyncio.sleep(0.1)
                await eventually(
                    lambda: states(consumer.on("/alarms/"))["store/journal"][0] == "normal",
                    "it is true again",
                )
                await eventually(
                    lambda: states(consumer.on("/alarms/"))["bearing-fault"][0] == "normal", "and all others"
                )
                await eventually(lambda: desk.outbox.counters.depth == 0, "all is told")
        for topic, number in before.items():
            told = [m.payload["sequence"] for m in consumer.on(topic)]
            assert max(told) > number, "a consumer that drops what is not newer hears of it"
        assert states(consumer.on("/alarms/"))["rotor-fault"][1] == "danger", "as the journal has it"
        # It is told once.
        async with desk_at(store, port) as desk:
            used = desk.outbox._books.last_sequence
            desk.tick()
            await asyncio.sleep(0.5)
            assert desk.outbox._books.last_sequence == used
