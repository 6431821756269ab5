"""Machine files read again while the service runs: refused as a whole, or applied by what is different."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import signal
import subprocess
import sys
import weakref
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import can
import numpy as np
import pytest
from support.brokers import Consumer, running_mosquitto
from support.can_gateway import daqsvc_run
from support.given_codes import had
from support.live_service import running_box
from support.machine_files import LAVAL
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.states import AlarmState
from daqsvc.box import BOX
from daqsvc.commands.machine_files import read_box
from daqsvc.commands.reload import other_files
from daqsvc.control import ControlServer, ReloadRefusedError, ask_reload
from daqsvc.reload import changes
from daqsvc.settings import MachineFileError, load_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.service import Service

pytestmark = pytest.mark.integration
RATE_HZ = 640.0
RIG = LAVAL.read_text().replace('interface = "socketcan"', 'interface = "virtual"').partition("[mqtt]")[0]
CASING = """
[buses.can1]
driver = "can"
interface = "virtual"
channel = "can1"
fd = true

[streams.casing]
bus = "can1"
rate_hz = 3200.0

[streams.casing.layout]
id = 0x201
length = 12
counter = { byte = 0, bits = 16, counts = "samples" }
first_byte = 4
samples_per_frame = 1
channels = [{ name = "de", type = "int16", scale = 0.001 }, { name = "nde", type = "int16", scale = 0.001 }]

[[sensors]]
name = "accel"
type = "accelerometer"
stream = "casing"
channel = "de"
unit = "g"

[[alarms]]
name = "accel-high"
sensor = "accel"
measure = "rms"
alert = 5.0
danger = 9.0
"""
MQTT_ELSEWHERE = '[mqtt]\nurl = "mqtt://127.0.0.1"\ninsecure = true\ntopic_root = "x"\n[pipeline]'
ANOTHER = """
[[sensors]]
name = "accel-nde"
type = "accelerometer"
stream = "casing"
channel = "nde"
unit = "g"
"""


async def unasked(command: AlarmCommand, source: str) -> NoReturn:
    raise AssertionError(f"{command} of {source}")


def put(file: Path, *changes_: tuple[str, str], more: str = "") -> None:
    """Write the machine file of the rig and its casing."""
    text = RIG + CASING
    for old, new in changes_:
        assert old in text, old
        text = text.replace(old, new)
    file.write_text(text + more)


@contextlib.asynccontextmanager
async def serving(*files: Path, store: Path) -> AsyncIterator[Service]:
    async with running_box(read_box(files), store, read_again=partial(read_box, files)) as service:
        yield service


@contextlib.asynccontextmanager
async def turning(service: Service, machine: str, stream: str = "shaft") -> AsyncIterator[CanNode]:
    """A device that sends for as long as this is entered."""
    driver = {one.name: one for one in service.driver_reports}["can0"]
    await eventually(lambda: driver.link.state == "up", "the bus is up")
    turns = np.arange(round(RATE_HZ * 60.0)) / RATE_HZ * 10.0
    x, y = 20.0 * np.cos(2 * np.pi * turns), -10.0 + 20.0 * np.sin(2 * np.pi * turns)
    samples = np.stack([x, y, np.where(turns % 1 < 0.1, -2.0, -10.0)], axis=1)
    with can.Bus(interface="virtual", channel="can0", protocol=can.CanProtocol.CAN_FD) as bus:
        node = CanNode(bus, frame_layout(service.box.machines[machine], stream), samples, RATE_HZ)
        playing = asyncio.create_task(node.play(RealTimePacer(SystemClock())))
        try:
            yield node
        finally:
            playing.cancel()
            await asyncio.wait({playing})


def counted(service: Service, stream: str = "shaft") -> dict[str, Any]:
    return dict(service.figures()["streams"][stream])


async def all_has_come(service: Service, node: CanNode, stream: str = "shaft") -> None:
    """What was sent until now has been received, and nothing is missing."""
    await eventually(lambda: counted(service, stream)["frames_received"] >= node.frames_sent, "all has come")
    assert counted(service, stream)["samples_lost"] == 0
    assert counted(service, stream)["gaps"] == 0


async def test_another_setpoint_leaves_buses_detectors_and_alarms_as_they_are(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    put(file)
    async with serving(file, store=tmp_path / "store") as service, turning(service, "laval-rig") as node:
        watch, driver = service.watches["laval-rig"], service.drivers[0]
        shown = lambda: service.alarms.manager.alarms["rotor-fault"]  # noqa: E731
        await eventually(lambda: shown().occurrence, "its unbalance raises an alarm")
        bypass = AlarmCommand(verb=Verb.BYPASS, alarm="rotor-fault", by="the test")
        assert (await service.alarms.execute(bypass, "test")).accepted
        before = shown()
        put(file, ("alert = 5.0", "alert = 4.0"))
        said = ["machine laval-rig: other alarms or setpoints (alarms.accel-high.alert 5.0 -> 4.0)"]
        answer = await asyncio.to_thread(ask_reload, tmp_path / "store", dry_run=True)
        assert (answer.accepted, list(answer.lines)) == (True, said)
        assert service.box.machines["laval-rig"].alarms[-1].alert == 5.0, "it was only asked"
        assert await service.reload() == said
        assert service.watches["laval-rig"] is watch
        assert service.drivers[0] is driver
        assert service.box.machines["laval-rig"].alarms[-1].alert == 4.0
        after = shown()
        assert (after.state, after.occurrence) == (before.state, before.occurrence)
        assert after.state is AlarmState.OUT_OF_SERVICE
        assert await service.reload() == []
        await all_has_come(service, node)


@pytest.mark.long
async def test_alarm_and_diagnosis_both_go_by_the_new_setpoint(tmp_path: Path) -> None:
    file, of_x = tmp_path / "rig.toml", 'or "crest_factor"\nalert = '
    put(file)

    async def stands() -> tuple[str, str]:
        status = json.loads(await service.reports["laval-rig"].line())
        [levels] = [one for one in status["statements"] if one["detector"] == "levels/probe-x"]
        high = [one for one in status["alarms"]["standing"] if one["alarm"] == "shaft-vibration-x"]
        return levels["severity"], high[0]["level"] if high else "normal"

    async def until(level: str) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while await stands() != (level, level):
                await asyncio.sleep(0.05)

    async with serving(file, store=tmp_path / "store") as service, turning(service, "laval-rig") as node:
        windows = lambda: service.watches["laval-rig"].pipeline.counters["levels/shaft"].windows  # noqa: E731
        await eventually(lambda: windows() > 2, "its levels are known: 14 um")
        assert await stands() == ("normal", "normal")
        for limits, level in (
            (("10.0", "60.0"), "alert"),
            (("5.0", "12.0"), "danger"),
            (("40.0", "60.0"), "normal"),
        ):
            put(file, (f"{of_x}40.0\ndanger = 60.0", f"{of_x}{limits[0]}\ndanger = {limits[1]}"))
            [said] = await service.reload()
            assert f" -> {limits[1]}" in said or level != "danger"
            await until(level)
        await all_has_come(service, node)


async def test_another_sensor_costs_no_other_bus_a_sample(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    put(file)
    async with serving(file, store=tmp_path / "store") as service, turning(service, "laval-rig") as node:
        await eventually(lambda: counted(service)["time_settled"], "its clock is known")
        shaft, casing = service.drivers
        put(file, more=ANOTHER)
        assert await service.reload() == [
            "machine laval-rig: detectors begin again (sensors.accel-nde is new, bus can1)",
            "bus can1 is opened again (units)",
        ]
        assert service.drivers[0] is shaft
        assert service.drivers[1] is not casing
        watch = service.watches["laval-rig"]
        assert [sensor.name for sensor in watch.machine.sensors][-1] == "accel-nde"
        await eventually(lambda: watch.pipeline.counters["rotor-bank"].windows > 20, "it is judged again")
        await all_has_come(service, node)
        received = counted(service)["samples_received"]
        assert watch.rings["shaft"].end_index == received, "one count over the reload"
        [report] = service.reports.values()
        assert b"accel-nde" in await report.line()


async def test_a_machine_comes_and_goes_while_another_is_watched(tmp_path: Path) -> None:
    plant = tmp_path / "plant"
    plant.mkdir()
    for name, number in (("one", 1), ("two", 2)):
        text = RIG.replace('name = "laval-rig"', f'name = "{name}"').replace("0x101", f"{0x100 + number:#x}")
        (plant / f"{name}.toml").write_text(text)
    second = (plant / "two.toml").read_text()
    (plant / "two.toml").unlink()
    async with serving(plant, store=tmp_path / "store") as service, turning(service, "one") as node:
        await eventually(
            lambda: service.watches["one"].pipeline.counters["rotor-bank"].windows > 10, "judged"
        )
        # On a bus of its own: what shares a bus is read by one driver, which then begins again.
        (plant / "two.toml").write_text(second.replace("buses.can0", "buses.b").replace('"can0"', '"b"'))
        assert await service.reload() == ["machine two is watched from now on", "bus b is opened"]
        assert sorted(service.alarms.managers) == [BOX, "one", "two"]
        bypass = AlarmCommand(verb=Verb.BYPASS, alarm="rotor-fault", by="the test", machine="two")
        assert (await service.alarms.execute(bypass, "test")).accepted
        await all_has_come(service, node, "one/shaft")
        (plant / "two.toml").unlink()
        assert await service.reload() == ["machine two is no longer watched", "bus b is closed"]
        assert [one.name for one in service.driver_reports] == ["can0"]
        latest = {m.topic: m for m in await service.alarms.outbox.latest()}
        assert b'"state":"normal"' in latest["daqsvc/lab/edge-1/two/alarms/rotor-fault"].payload
        await all_has_come(service, node, "one/shaft")


async def test_what_is_on_a_bus_that_is_opened_anew_is_judged_again(tmp_path: Path) -> None:
    plant = tmp_path / "plant"
    plant.mkdir()
    for name, number in (("one", 1), ("two", 2)):
        text = RIG.replace('name = "laval-rig"', f'name = "{name}"').replace("0x101", f"{0x100 + number:#x}")
        (plant / f"{name}.toml").write_text(text)
    async with serving(plant, store=tmp_path / "store") as service:
        judged = lambda: service.watches["one"].pipeline.counters["rotor-bank"].windows  # noqa: E731
        async with turning(service, "one"):
            await eventually(lambda: judged() > 10, "judged")
        gone = weakref.ref(service.watches["one"].pipeline)
        gc.disable()
        try:
            (plant / "two.toml").unlink()
            assert await service.reload() == [
                "machine two is no longer watched",
                "machine one: detectors begin again (bus can0)",
                "bus can0 is opened again (its streams, units)",
            ]
            assert gone() is None, "its memory is free without the collector, which would hold up the loop"
        finally:
            gc.enable()
        async with turning(service, "one"):
            await eventually(lambda: judged() > 10, "judged again")
        (plant / "one.toml").write_text(
            (plant / "one.toml").read_text().replace('start = "retry"', 'start = "ignore"')
        )
        await service.reload()
        async with turning(service, "one"):
            await eventually(lambda: judged() > 10, "judged once more")
        assert not service.supervisor.failures
        [report] = service.reports.values()
        status = json.loads(await report.line())
        assert status["uptime_s"] > 1.0, "of the service, not of the machine"
        assert status["buses"]["can0"]["state"] == "up"


ABSENT = """
[buses.port]
driver = "serial"
port = "{port}"
framing = "lines"
baud = 115_200
start = "error"

[streams.more]
bus = "port"
rate_hz = 50.0

[streams.more.layout]
line = ["seq", "x"]
counter = {{ column = "seq" }}
channels = [{{ name = "x" }}]
"""


@pytest.mark.gives("B29")
async def test_a_new_bus_may_be_absent_whatever_it_says_of_the_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file, absent = tmp_path / "rig.toml", tmp_path / "nowhere"
    put(file)
    async with serving(file, store=tmp_path / "store") as service:
        put(file, more=ABSENT.format(port=absent))
        await service.reload()
        said = lambda: [text for text in caplog.messages if f"{absent}" in text]  # noqa: E731
        await eventually(said, "it is said that it is absent")
        assert "it is being tried again" in said()[0]
        assert not service.supervisor.failures
    assert not any("failed" in text for text in caplog.messages)


async def test_a_stop_in_the_middle_of_a_reload_is_a_stop(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "rig.toml"
    put(file)
    began = asyncio.Event()

    async def hang(*_: object) -> None:
        began.set()
        await asyncio.Event().wait()

    async with serving(file, store=tmp_path / "store") as service:
        monkeypatch.setattr(service, "_change_alarms", hang)
        put(file, more=ANOTHER)
        reloading = asyncio.create_task(service.reload())
        await began.wait()
    with pytest.raises(ReloadRefusedError, match="the service ends"):
        await reloading
    assert not service.supervisor.failures
    assert not [one for one in caplog.records if one.name == "daqsvc.supervision"]


async def test_another_broker_gets_what_happens_from_then_on(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with running_mosquitto(tmp_path / "a") as first, running_mosquitto(tmp_path / "b") as second:
        broker = '\n[mqtt]\nurl = "mqtt://127.0.0.1:{}"\ninsecure = true\n'
        put(file, more=broker.format(first.port))
        async with Consumer(second.port) as consumer, serving(file, store=tmp_path / "store") as service:
            await eventually(lambda: service.figures()["mqtt"]["connected"], "the first is connected")
            put(file, more=broker.format(second.port))
            assert await service.reload() == ["outputs begin again ([mqtt])"]
            bypass = AlarmCommand(verb=Verb.BYPASS, alarm="rotor-fault", by="the test")
            assert (await service.alarms.execute(bypass, "test")).accepted
            await eventually(lambda: consumer.on("alarms/rotor-fault"), "the second one is told")
            put(file)
            assert await service.reload() == ["outputs begin again ([mqtt])"]
            assert not service.alarms.outputs
            await eventually(
                lambda: [m.payload["state"] for m in consumer.on("availability")][-1] == "offline", "it left"
            )


async def test_what_cannot_be_is_refused_whole(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    put(file)
    async with serving(file, store=tmp_path / "store") as service, turning(service, "laval-rig") as node:
        watch, box = service.watches["laval-rig"], service.box
        for words, change in {
            'rate_hz = "fast": must be a number': ("rate_hz = 3200.0", 'rate_hz = "fast"'),
            'site = "plant": the service runs with "lab", and changes that only when it starts. Remedy: '
            "restart the service": ('site = "lab"', 'site = "plant"'),
            'mqtt.topic_root = "x": the service runs with "daqsvc"': ("[pipeline]", MQTT_ELSEWHERE),
            'machine.name = "x": the service runs with "laval-rig"': ('name = "laval-rig"', 'name = "x"'),
        }.items():
            put(file, change, ("alert = 5.0", "alert = 4.0"))
            with pytest.raises(ReloadRefusedError) as refused:
                await service.reload()
            [reason] = refused.value.reasons
            assert words in reason
            assert reason.endswith("[F07]" if "fast" in reason else "[S01]")
            if "topic_root" in reason:
                had("S01", reason)
            place, line, _ = reason.split(":", 2)
            assert place == f"{file}"
            written = words.partition(" =")[0].rpartition(".")[2]
            assert written in file.read_text().splitlines()[int(line) - 1], reason
        put(file, ("rate_hz = 3200.0", 'rate_hz = "fast"'), ("gap_ok_v", "gap"))
        with pytest.raises(ReloadRefusedError) as refused:
            await service.reload()
        with pytest.raises(MachineFileError) as unsound:
            load_machine_file(file)
        assert refused.value.reasons == [f"{problem}" for problem in unsound.value.problems], "as check says"
        put(file, more=f'\n[store]\ndirectory = "{tmp_path}/other"\n')
        with pytest.raises(
            ReloadRefusedError, match=r'store\.directory = "/.*/other": the service runs with none'
        ):
            await service.reload()
        file.unlink()
        with pytest.raises(ReloadRefusedError, match="no such file"):
            await service.reload()
        assert service.box is box
        assert service.watches["laval-rig"] is watch
        assert box.machines["laval-rig"].alarms[-1].alert == 5.0
        await all_has_come(service, node)


def test_a_limit_of_the_store_that_needs_a_restart_is_named_with_its_place(tmp_path: Path) -> None:
    file, store = tmp_path / "rig.toml", '\n[store]\ndirectory = "/x"\n'
    put(file, more=store)
    before = read_box([file])
    put(file, more=f"{store}reserve_mb = 1\n")
    with pytest.raises(ReloadRefusedError) as refused:
        changes(before, read_box([file]))
    lines = file.read_text().splitlines()
    place = f"{file}:{lines.index('reserve_mb = 1') + 1}: store.reserve_mb = 1"
    assert refused.value.reasons[0].startswith(f"{place}: the service runs with 64, and")


def test_what_is_different_is_said_with_its_reason(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    put(file)
    before = read_box([file])
    assert not changes(before, read_box([file]))
    for change, said in {
        ("ring_s = 30.0", "ring_s = 20.0"): [
            "machine laval-rig: detectors begin again (pipeline.ring_s 30.0 -> 20.0)"
        ],
        ("id = 0x201", "id = 0x202"): [
            "machine laval-rig: detectors begin again (streams.casing.layout.id 513 -> 514, bus can1)",
            "bus can1 is opened again (its streams)",
        ],
        ('channel = "can1"', 'channel = "can2"'): [
            "machine laval-rig: detectors begin again (bus can1)",
            "bus can1 is opened again (its table)",
        ],
        ("shelve_at_most_s = 28_800.0", "shelve_at_most_s = 60.0"): [
            "machine laval-rig: other alarms or setpoints (alarm_handling.shelve_at_most_s 28800.0 -> 60.0)"
        ],
        ("latching = true  ", "latching = false  "): [
            "machine laval-rig: other alarms or setpoints (alarms.rotor-fault.latching True -> False)"
        ],
    }.items():
        put(file, change)
        assert changes(before, read_box([file])).lines() == said


@pytest.mark.parametrize(
    ("started", "named", "lines", "is_told"),
    [
        (["plant/a.toml"], "plant", (), True),
        (["plant/a.toml", "plant/b.toml"], "plant/b.toml", (), False),
        (["plant"], "plant", (), False),
        (["plant"], "plant/a.toml", (), True),
        (
            ["plant"],
            "plant/a.toml",
            ("machine a: other alarms or setpoints (alarms.a.alert 1.0 -> 2.0)",),
            False,
        ),
    ],
)
async def test_who_names_other_files_than_the_service_reads_is_told(
    started: list[str], named: str, lines: tuple[str, ...], *, is_told: bool, tmp_path: Path
) -> None:
    async def reload(*, dry_run: bool = False) -> list[str]:
        assert not dry_run
        return [*lines]

    files = [tmp_path / file for file in started]
    control = ControlServer(tmp_path, [], unasked, reload=reload, files=files)
    await control.open()
    serving_ = asyncio.create_task(control.serve())
    answer = await asyncio.to_thread(ask_reload, tmp_path)
    serving_.cancel()
    await asyncio.wait({serving_})
    await control.close()
    paths = " ".join(map(str, files))
    told = f"the service was started with {paths}: it reads that again, also if another one is named here"
    assert other_files(tmp_path / named, answer) == (told if is_told else "")


@pytest.mark.long
async def test_a_process_reloads_by_sighup_and_by_the_verb(tmp_path: Path) -> None:
    file, store = tmp_path / "rig.toml", tmp_path / "store"
    put(file)
    verb = partial(subprocess.run, capture_output=True, text=True, check=False, timeout=60)
    reload = [sys.executable, "-m", "daqsvc", "reload", "--store", f"{store}"]
    log = tmp_path / "log"
    async with daqsvc_run(file, store) as process:
        await eventually(lambda: "watching laval-rig" in log.read_text(), "it runs")
        put(file, ("alert = 5.0", "alert = 4.0"))
        dry = await asyncio.to_thread(verb, [*reload, "--dry-run"])
        said = "machine laval-rig: other alarms or setpoints (alarms.accel-high.alert 5.0 -> 4.0)\n"
        assert (dry.returncode, dry.stdout) == (0, said), dry
        process.send_signal(signal.SIGHUP)
        await eventually(lambda: "reloaded: machine laval-rig: other" in log.read_text(), "it has reloaded")
        done = await asyncio.to_thread(verb, reload)
        assert (done.returncode, done.stdout, done.stderr) == (0, "nothing is different\n", "")
        file.write_text("nonsense")
        refused = await asyncio.to_thread(verb, reload)
        assert refused.returncode == 2
        assert f"{file}:1: is not valid TOML" in refused.stderr
        process.send_signal(signal.SIGHUP)
        await eventually(lambda: "SIGHUP is refused" in log.read_text(), "it is refused")
        assert process.poll() is None
