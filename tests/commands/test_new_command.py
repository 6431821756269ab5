"""``daqsvc new``: whatever is answered, the file that it writes can be used; and how it asks."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.only_table import only_bus, only_stream
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.commands.new.buses import buses
from daqsvc.commands.new.interview import Given, checked, conduct, refusal, take
from daqsvc.commands.new.machine_text import machine_text, questions
from daqsvc.commands.new.topics import all_topics
from daqsvc.settings import load_machine_file
from drivers.bus_questions import Heard
from drivers.questions import bit_rate, doubt_of_speed, number_in, rate_hz, seconds_or_auto, speed_rpm

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.bus_questions import BusQuestions
    from drivers.questions import Answers, Question

pytestmark = pytest.mark.integration
DBC = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"
NEEDED = {
    "dbc": f"{DBC}",
    "host": "192.0.2.10",
    "port": "/dev/serial/by-id/usb-logger",
    "alert": "0.1",
}
"""Answers to what has no default."""
PLAIN = st.characters(codec="utf-8", exclude_categories=["C", "Z"])
WORDS = st.text(st.one_of(PLAIN, st.sampled_from(" \"'\\#[]=,{}")), max_size=40)
NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,20}", fullmatch=True)
NUMBERS = st.floats(-1e6, 1e6).map(repr)
FREE = {
    "seconds": st.sampled_from(["auto", "0.5", "20"]),
    "suffix": st.sampled_from(["none", "mm/s", "C"]),
    "name": st.builds("{}a{}".format, WORDS, WORDS),
    "site": NAMES,
    "box": NAMES,
    "interface": st.sampled_from(["socketcan", "pcan", "slcan"]),
    "socket": NAMES.map("/run/{}".format),
    "channel": st.one_of(NAMES, WORDS),
    "bitrate": st.sampled_from(["125000", "500000", "1000000"]),
    "data-bitrate": st.sampled_from(["2000000", "8000000"]),
    "dbc": st.just(f"{DBC}"),
    "signals": st.sampled_from(["AccelX", "AccelY, AccelZ", "Status, AccelX, AccelZ"]),
    "id": st.integers(0, 0x1FFF_FFFF).map(hex),
    "channels": st.lists(NAMES, min_size=1, max_size=6, unique=True).map(", ".join),
    "scale": st.one_of(NUMBERS, st.sampled_from(["0.001", "0.0005", "-0.01", "1"])),
    "samples-per-frame": st.integers(1, 40).map(str),
    "host": st.sampled_from(["192.0.2.10", "gateway.example", "::1"]),
    "tcp-port": st.integers(1, 65_535).map(str),
    "port": WORDS.map("/dev/tty{}".format),
    "baud": st.sampled_from(["9600", "19200", "115200", "3000000"]),
    "unit": st.integers(1, 247).map(str),
    "timeout-ms": st.one_of(st.sampled_from(["500", "1500", "20"]), NUMBERS),
    "bits": st.sampled_from(["none", "0", "3", "4-7", "7-4", "15-16", "all"]),
    "block-id": st.integers(0, 65_535).map(str),
    "block-address": st.integers(0, 65_535).map(str),
    "samples": st.sampled_from(["64", "1024", "8192"]),
    "columns": st.lists(NAMES, min_size=2, max_size=6, unique=True).map(", ".join),
    "count-address": st.integers(0, 65_535).map(str),
    "ring-address": st.integers(0, 65_535).map(str),
    "fifo-address": st.integers(0, 65_535).map(str),
    "acknowledge": st.one_of(st.just("none"), st.integers(0, 65_535).map(str)),
    "depth": st.sampled_from(["2", "256", "1000", "1024", "32768"]),
    "sync-word": st.sampled_from(["a55a", "0xFF 00", "zz", "00112233445566"]),
    "payload-length": st.integers(0, 4096).map(str),
    "counter-byte": st.one_of(st.just("none"), st.integers(0, 64).map(str)),
    "first-byte": st.integers(0, 64).map(str),
    "length": st.sampled_from(["6", "8", "12", "13", "64"]),
    "separator": st.sampled_from([",", ";", " ", r"\t"]),
    "prefix": st.sampled_from(["none", "$ACC", "LOG"]),
    "speed": st.one_of(st.sampled_from(["600", "1480", "-3000", "12000", "90"]), NUMBERS),
    "rate": st.one_of(st.sampled_from(["1", "100", "2560", "12800", "25600"]), NUMBERS),
    "alert": NUMBERS,
    "danger": NUMBERS,
    "broker": st.sampled_from(["none", "mqtt://127.0.0.1:1883", "mqtts://broker.example:8883"]),
    "username": st.one_of(st.just("none"), WORDS),
    "password-file": WORDS,
    "units": st.sampled_from(["auto", "1-247", "5,17", "0-300", "all"]),
    "registers": st.sampled_from(["auto", "4000-4019", "17", "30001-30010", "400001-400010", "9-3"]),
    "no-value": st.sampled_from(["none", "0x7FFF", "0xFFFF", "-1", "70000", "0xFFFFFFFF"]),
    "address": st.integers(0, 65_535).map(str),
    "sensitivity": st.sampled_from(["none", "7.87", "100", "4", "10.2"]),
    "angle": st.integers(-360, 360).map(str),
    "max-count": st.sampled_from(["125", "8", "1"]),
    "threshold": st.sampled_from(["-6", "2.5", "0"]),
    "bearing": st.sampled_from(["none", "6205-2RS", "6203", "9, 7.94, 39.04", "12, 8, 50, 15"]),
}


def strategy(question: Question) -> st.SearchStrategy[str]:
    """Answers to a question; most of them can be used, with the answers before."""
    topic = question.key.rpartition(".")[2]
    if question.choices:
        return st.sampled_from(sorted(question.choices))
    if topic == "unit" and "." in question.key:
        return st.sampled_from(["mm/s", "degC", "bar", "µm", "%"])
    return NAMES if topic == "name" and "." in question.key else FREE[topic]


@pytest.mark.long
@settings(
    max_examples=examples(90),
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(data=st.data())
def test_whatever_is_answered_the_file_passes_check(data: st.DataObject) -> None:
    file = Path("/nowhere/machine.toml")
    answers: dict = {}
    for question in questions(answers, file.parent):
        asked = data.draw(st.booleans()) if question.default is not None else True
        text = data.draw(strategy(question), label=question.key) if asked else question.default
        reason = take(question, text, answers, file)
        if reason is not None:
            # An answer that is asked again: with a reason, and the default will do.
            assert len(reason) > 10
            topic = question.key.rpartition(".")[2]
            sure = question.default if question.default is not None else NEEDED[topic]
            assert take(question, sure, answers, file) is None, (question.key, sure)
    text = machine_text(answers, file.name)
    machine = checked(text, file)
    assert machine.machine.description in {answers["name"], ""}
    assert machine.machine.speed_rpm == answers["speed"]


@settings(
    max_examples=examples(30),
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(data=st.data())
def test_whatever_is_heard_the_file_passes_check(data: st.DataObject) -> None:
    file = Path("/nowhere/machine.toml")
    bus = data.draw(st.sampled_from(sorted(name for name, one in buses().items() if one.listens_behind)))
    keys = [*all_topics(), *(f"sensor.{channel}.{topic}" for channel in "xy" for topic in SENSOR_ONES)]
    proposed = {
        key: data.draw(st.one_of(FREE.get(key.rpartition(".")[2], WORDS), WORDS, NUMBERS), label=key)
        for key in data.draw(st.sets(st.sampled_from(keys))) - {"rate"}  # one that cannot be is refused
    }
    heard: list[str] = []

    def listen(kind: BusQuestions, answers: Answers) -> Heard:
        heard.append(kind.listens_behind)
        assert kind.listens_behind in answers
        return HeardThis(proposed)

    beforehand = Given({"bus": bus, **NEEDED_OF.get(bus, {})}, defaults=True)
    answers = conduct(file, beforehand, None, print, listen)
    assert len(heard) == 1
    checked(machine_text(answers, file.name), file)


class HeardThis(Heard):
    """Proposals, whatever has been answered."""

    def __init__(self, proposed: Mapping[str, str]) -> None:
        super().__init__([])
        self._proposed = proposed

    def proposals(self, answers: Answers) -> Mapping[str, str]:
        del answers
        return self._proposed


SENSOR_ONES = ("type", "name", "unit", "angle", "address", "register-type", "order")


def grid() -> list[dict[str, str]]:
    """Answers of all kinds of buses and limits, one by one."""
    cases = [
        {"bus": bus, "limits": limits, **NEEDED_OF.get(bus, {})}
        for bus in buses()
        for limits in ("none", "iso", "own")
    ]
    for case in cases:
        if case["limits"] == "own":
            case["alert"] = "2.5"
    cases += [{"bus": "modbus-tcp", "host": "::1", "way": "waveform", "sensor.x.bearing": "6205-2RS"}]
    cases += [{"bus": "serial", "port": "/dev/ttyS0", "framing": framing} for framing in ("cobs", "sync")]
    wide = {"channels": "x", "sensor.x.register-type": "uint64", "sensor.x.unit": "kWh"}
    cases += [{"bus": "modbus-tcp", "host": "::1", "limits": "none", **wide}]
    cases += [{"bus": "modbus-tcp", "host": "::1", "way": way} for way in ("ring", "fifo")]
    slow = {"bus": "modbus-rtu", "port": "/dev/ttyS0"}  # a queue so slow that its values are no vibration
    cases += [{**slow, "way": "ring"}, {**slow, "way": "fifo", "limits": "none"}]
    cases += [{"bus": "modbus-tcp", "host": "::1", "way": "fifo", "acknowledge": "700"}]
    cases += [{"bus": "can", "broker": "mqtts://broker.example", "username": "daq", "home-assistant": "yes"}]
    return cases


NEEDED_OF = {
    "can-dbc": {"dbc": f"{DBC}"},
    "modbus-tcp": {"host": "192.0.2.10"},
    "modbus-rtu": {"port": "/dev/ttyS0"},
    "serial": {"port": "/dev/ttyS0"},
}


@pytest.mark.long
@pytest.mark.parametrize("case", grid(), ids=lambda case: " ".join(case.values()))
def test_without_a_terminal_options_and_defaults_make_a_file_without_other_warnings(tmp_path, capsys, case):
    file = tmp_path / "m.toml"
    texts = {key: value for key, value in case.items() if not key.startswith("sensor.")}
    options = [f"--{key}={value}" for key, value in texts.items()]
    options += [f"--sensor={key[7:]}={value}" for key, value in case.items() if key not in texts]
    assert main(["new", f"{file}", "--yes", *options]) == 0
    said = capsys.readouterr().out
    assert f"{file} is written; daqsvc check finds no error in it." in said
    machine = load_machine_file(file)
    # Which value of a register means that there is none, only its manual states.
    modbus_values = case["bus"].startswith("modbus") and "way" not in case and "channels" not in case
    assert {f"{one.code}" for one in machine.warnings} == ({"B45"} if modbus_values else set())
    assert bool(machine.alarms) == (case.get("limits") != "none")
    # What it says to type next is what there is to type.
    verbs = [line.split()[1] for line in said.partition("Next:")[2].splitlines() if line.strip()]
    assert verbs == ["check", "run", "sim" if case["bus"] == "virtual" else "status"]
    assert main(["check", f"{file}"]) == 0


def test_the_first_line_names_the_schema_that_the_file_itself_says_how_to_make(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "m.toml", "--yes"]) == 0
    text = Path("m.toml").read_text()
    named = Path(text.partition("\n")[0].removeprefix("#:schema "))
    command = next(line[1:].split() for line in text.splitlines() if "check --schema" in line)
    assert command == ["daqsvc", "check", "--schema", ">", named.name]
    assert named.parent == Path()  # beside the machine file, found without a network
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(command[1:3])
    from jsonschema import Draft7Validator  # slow to import

    Draft7Validator(json.loads(capsys.readouterr().out)).validate(tomllib.loads(text))
    assert load_machine_file(Path("m.toml")).warnings == ()


@pytest.mark.parametrize(
    ("channel", "scale", "unit"),
    [
        ("vibration", 0.01, "mm/s"),
        ("Velocity-x", 0.01, "mm/s"),
        ("oil-temp", 0.1, "degC"),
        ("level", 1.0, "1"),
        ("status", 1.0, "1"),
        ("motor-speed", 1.0, "rpm"),
        ("r17", 1.0, "count"),
        ("temp1", 0.1, "degC"),
    ],
)
def test_the_worth_of_a_count_is_guessed_only_where_the_name_tells_it(channel, scale, unit):
    given = {"host": "192.0.2.10", "bus": "modbus-tcp", "channels": channel}
    answers = conduct(Path("m.toml"), Given(given | {"limits": "none"}, defaults=True), None, print)
    assert (answers[f"sensor.{channel}.scale"], answers[f"sensor.{channel}.unit"]) == (scale, unit)


@pytest.mark.parametrize(("rate", "limits"), [("50", "none"), ("100", "iso")])
def test_samples_that_are_too_slow_for_1x_get_no_zones_of_vibration(rate, limits):
    given = {"bus": "serial", "port": "/dev/ttyS0", "columns": "n, x", "rate": rate, "speed": "1480"}
    given["sensor.x.type"] = "accelerometer"
    answers = conduct(Path("m.toml"), Given(given, defaults=True), None, print)
    assert answers["limits"] == limits


def test_a_value_whose_name_tells_no_vibration_gets_no_limits_of_one(tmp_path):
    given = {"host": "h", "bus": "modbus-tcp", "channels": "vibration, power, status, flow"}
    answers = conduct(tmp_path / "m.toml", Given(given, defaults=True), None, print)
    assert answers["limits"] == "iso"
    alarms = tomllib.loads(machine_text(answers, "m.toml"))["alarms"]
    assert [one["sensor"] for one in alarms] == ["vibration"]


@pytest.mark.parametrize(
    ("options", "unit"),
    [
        (["--bus=modbus-tcp", "--host=::1", "--channels=vib_peak"], "mm/s"),
        (
            [
                *("--bus=serial", "--port=/dev/ttyS0", "--columns=n,v", "--counter=n", "--rate=10"),
                "--sensor=v.suffix=mm/s pk",
            ],
            "mm/s pk",
        ),
    ],
)
def test_a_peak_value_gets_no_zones_of_an_rms_on_any_bus(tmp_path, options, unit):
    file = tmp_path / "m.toml"
    assert main(["new", "--yes", *options, f"{file}"]) == 0
    machine = load_machine_file(file)
    assert [one.unit for one in machine.sensors] == [unit]
    assert not machine.alarms
    assert "The zones of ISO 20816-3 are not for every velocity" in file.read_text()


def assumed_keys(text: str) -> set[str]:
    """Keys of the lines that are marked; of a channel, ``channels``, or what of it is assumed."""
    marked = [line.strip() for line in text.splitlines() if "  # assumed" in line]
    found = {line.partition(" = ")[0] for line in marked if not line.startswith("{")}
    for line in marked:
        if line.startswith("{"):
            _, _, parts = line.partition("  # assumed")
            named = [part for part in parts.removeprefix(": ").split(", ") if part]
            found |= {f"{part} of channels" for part in named} or {"channels"}
    return found


@pytest.mark.parametrize(
    ("options", "assumed"),
    [
        (
            ["--bus=modbus-tcp", "--host=h"],
            {"speed_rpm", "rate_hz", "way", "unit", "table", "channels", "zones"},
        ),
        (
            ["--bus=modbus-tcp", "--host=h", "--speed=2960", "--class=1-rigid", "--unit=3", "--table=input"],
            {"rate_hz", "way", "unit", "channels"},  # units of sensors, by the names of example channels
        ),
        (
            ["--bus=serial", "--port=/dev/ttyS0"],
            {"speed_rpm", "rate_hz", "baud", "framing", "line", "time", "type", "unit", "zones"},
        ),
        (
            ["--bus=can-dbc", f"--dbc={DBC}"],
            {"speed_rpm", "rate_hz", "bitrate", "channel", "counter", "zones"},
        ),
        ([], set()),  # simulated
    ],
)
def test_what_nobody_has_stated_is_named_and_marked_in_the_file(tmp_path, capsys, options, assumed):
    file = tmp_path / "m.toml"
    assert main(["new", f"{file}", "--yes", *options]) == 0
    text, said = file.read_text(), capsys.readouterr().out
    found = assumed_keys(text)
    assert assumed <= found
    assert not found & {"speed_rpm", "zones", "table", "baud"} - assumed
    if not assumed:
        assert "ssumed" not in said + text
        return
    [words] = [line for line in said.splitlines() if line.startswith("Assumed, as nobody has stated it: ")]
    assert set(words.partition(": ")[2].partition(". ")[0].split(", ")) == found
    assert "# Assumed, as nobody has stated it: " in text
    load_machine_file(file)


def test_what_enter_took_of_the_machine_is_marked_and_what_was_typed_is_not(tmp_path):
    given = {"bus": "modbus-tcp", "host": "h", "channels": "vibration", "table": "holding"}

    def marked(**typed: str) -> set[str]:
        answers = conduct(
            tmp_path / "m.toml", Given(given, defaults=False), lambda asked: typed.get(asked.key, ""), print
        )
        return assumed_keys(machine_text(answers, "m.toml"))

    of_channels = {f"{part} of channels" for part in ("address", "type", "scale")}
    assert marked() == {"speed_rpm", "rate_hz", "way", "unit", "zones"} | of_channels
    typed = {"speed": "1480", "class": "2-rigid", "rate": "1", "way": "values", "unit": "1"}
    values = {"address": "0", "register-type": "uint16", "scale": "0.01", "unit": "mm/s"}
    typed |= {f"sensor.vibration.{key}": text for key, text in values.items()}
    assert marked(**typed) == set()
    del typed["sensor.vibration.scale"]
    assert marked(**typed) == {"scale of channels"}


def test_what_was_heard_is_not_assumed_though_it_is_the_usual_value(tmp_path):
    given = {"bus": "serial", "port": "/dev/ttyS0"}
    shown = {"baud": "115200", "framing": "lines", "columns": "t, x", "counter": "t", "counts": "ms"}
    shown |= {"separator": ",", "checksum": "none", "sensor.x.suffix": "mm/s", "rate": "100"}
    heard = HeardThis(shown)
    answers = conduct(tmp_path / "m.toml", Given(given, defaults=True), None, print, lambda *_: heard)
    assert assumed_keys(machine_text(answers, "m.toml")) == {"speed_rpm", "zones"}
    del shown["baud"], shown["separator"], shown["sensor.x.suffix"]
    answers = conduct(tmp_path / "m.toml", Given(given, defaults=True), None, print, lambda *_: heard)
    assert assumed_keys(machine_text(answers, "m.toml")) == {
        *("speed_rpm", "zones", "baud", "separator", "type", "unit")
    }


@pytest.mark.parametrize("way", ["waveform", "ring", "fifo"])
@pytest.mark.parametrize("defaults", [True, False])
def test_listening_shows_nothing_of_how_samples_lie_in_registers(tmp_path, way, defaults):
    given = {"bus": "modbus-tcp", "host": "h", "unit": "33", "way": way, "speed": "1500", "class": "2-rigid"}
    heard = HeardThis({"unit": "33", "table": "holding", "channels": "r4352, r4353"})

    def marked(listen) -> tuple[set[str], list[str]]:
        beforehand = Given(given, defaults)
        ask = None if defaults else lambda _question: ""
        answers = conduct(tmp_path / "m.toml", beforehand, ask, print, listen)
        return assumed_keys(machine_text(answers, "m.toml")), answers["notes"]

    keys, notes = marked(lambda *_: heard)
    layouts = {"waveform": {"block_id", "samples"}, "ring": {"count", "depth"}, "fifo": {"count"}}
    of_channels = {"type of channels", "scale of channels"}  # their names were heard
    assert keys == {"rate_hz", "address", "type", "unit"} | of_channels | layouts[way]
    [words] = [one for one in notes if one.startswith("Assumed, as nobody has stated it: ")]
    assert set(words.partition(": ")[2].partition(". ")[0].split(", ")) == keys
    assert marked(None)[0] - keys <= {"table", "channels"}


@pytest.mark.parametrize(
    "bus",
    [
        {"bus": "modbus-tcp", "host": "h", "way": "waveform", "unit": "1", "rate": "6400"},
        {"bus": "serial", "port": "/dev/ttyS0", "framing": "cobs", "rate": "1000"},
        {"bus": "can", "id": "0x201", "rate": "6400"},
    ],
)
@pytest.mark.parametrize("scale", [None, "0.001", "2"])
def test_a_scale_that_is_stated_makes_no_other_sensor_and_is_not_assumed(tmp_path, bus, scale):
    given = {**bus, "channels": "de, fe"} | ({} if scale is None else {"scale": scale})
    answers = conduct(
        tmp_path / "m.toml",
        Given(given, defaults=True),
        None,
        print,
        lambda *_: HeardThis({"scale": "1", "raw-type": "int16"}),
    )
    text = machine_text(answers, "m.toml")
    assert [one["type"] for one in tomllib.loads(text)["sensors"]] == ["accelerometer"] * 2
    assert "gap_ok_v" not in text
    assert not {"channels", "name of channels", "scale of channels"} & assumed_keys(text)
    beforehand = Given({key: text for key, text in given.items() if key != "channels"}, defaults=True)
    answers = conduct(tmp_path / "m.toml", beforehand, None, print)
    keys = assumed_keys(machine_text(answers, "m.toml"))
    assert keys >= ({"channels"} if scale is None else {"name of channels", "type of channels"})
    assert "scale of channels" not in keys


@pytest.mark.parametrize(
    ("typed", "unit", "iso"),
    [
        ("mm/sec", "mm/s", True),
        ("MM/S rms", "mm/s", True),
        ("mm/s peak", "mm/s peak", False),
        ("in/s", "in/s", False),
        ("ips", "in/s", False),
        ("°C", "degC", None),
        ("pulses", "pulses", None),
    ],
)
def test_a_unit_is_understood_as_it_is_typed_and_a_velocity_without_zones_is_named(
    tmp_path, capsys, typed, unit, iso
):
    file = tmp_path / "m.toml"
    words = ["new", f"{file}", "--yes", "--overwrite", "--bus=modbus-tcp", "--host=h", "--limits=iso"]
    both = [*words, "--channels=velocity, vib2", f"--sensor=velocity.unit={typed}"]
    assert main(both) == 0
    said = capsys.readouterr().out
    machine = load_machine_file(file)
    assert [one.unit for one in machine.sensors] == [unit, "mm/s"]
    assert [one.sensor for one in machine.alarms] == ["velocity"] * bool(iso) + ["vib2"]
    note = f"they are of a velocity RMS in mm/s, and velocity ({unit}) is not."
    assert (note in said) == (iso is False)
    assert ("1 in/s is 25.4 mm/s" in said) == (unit == "in/s")
    # Where no other one has zones, whoever wants them is told the same.
    alone = [*words, "--channels=velocity", f"--sensor=velocity.unit={typed}"]
    assert main(alone) == (0 if iso else 2)
    assert (f"--limits iso: No zones of ISO 20816-3: {note}" in capsys.readouterr().err) == (iso is False)


def test_two_figures_are_limits_of_one_quantity_only(tmp_path, capsys):
    """Values without a unit are anything: one of them may be a temperature."""
    file = tmp_path / "m.toml"
    words = ["--yes", "--bus=modbus-tcp", "--host=h", "--limits=own"]
    plain = [*words, "--channels=flow, level"]
    assert main(["new", f"{file}", *plain]) == 2
    assert "Alert limit (value of flow in 1): give --alert" in capsys.readouterr().err
    assert main(["new", f"{file}", *plain, "--alert=5", "--danger=8"]) == 0
    note = "Alert and danger are for flow. No alarm watches level yet: write one for each."
    assert note in capsys.readouterr().out
    assert f"# {note}" in file.read_text()
    assert [one.sensor for one in load_machine_file(file).alarms] == ["flow"]
    same = ["--overwrite", "--channels=temp1, temp2", "--alert=80", "--danger=95"]
    assert main(["new", f"{file}", *words, *same]) == 0
    assert [one.sensor for one in load_machine_file(file).alarms] == ["temp1", "temp2"]
    assert "No alarm watches" not in capsys.readouterr().out


def test_the_unit_that_a_name_suggests_is_the_same_on_every_bus(tmp_path):
    for bus, words in (
        ("modbus-tcp", {"host": "h"}),
        ("serial", {"port": "/dev/ttyUSB0", "columns": "t, rpm"}),
    ):
        texts = words | {"bus": bus, "channels": "rpm", "rate": "1", "limits": "none"}
        if bus == "serial":
            del texts["channels"]
        answers = conduct(tmp_path / "m.toml", Given(texts, defaults=True), None, print)
        assert answers["sensor.rpm.unit"] == "rpm", bus


@pytest.mark.parametrize(
    ("name", "counts"), [("n", "count"), ("seq", "count"), ("t", "ms"), ("Timestamp", "ms"), ("x1", "count")]
)
def test_a_column_is_a_time_only_if_its_name_means_one(tmp_path, name, counts):
    texts = {"bus": "serial", "port": "/dev/ttyUSB0", "columns": f"{name}, x", "counter": name}
    assert conduct(tmp_path / "m.toml", Given(texts, defaults=True), None, print)["counts"] == counts


def test_the_mark_for_no_value_of_a_register_is_an_option_and_a_hint_in_the_file(tmp_path, capsys):
    file = tmp_path / "m.toml"
    words = ["new", f"{file}", "--yes", "--overwrite", "--bus=modbus-tcp", "--host=192.0.2.10"]
    assert main(words) == 0
    assert "add e.g. no_value = 0x7FFF to its channel" in file.read_text()
    assert main([*words, "--sensor=temperature.no-value=0x8000"]) == 0
    text = file.read_text()
    assert text.count("no_value = 0x8000") == text.count("no_value") == 1
    capsys.readouterr()
    assert main([*words, "--sensor=temperature.no-value=0x18000"]) == 2
    assert "int16 cannot hold 98304" in capsys.readouterr().err


def test_the_byte_order_of_registers_may_be_in_small_letters(tmp_path, capsys):
    given = {"bus": "modbus-tcp", "host": "h", "channels": "flow", "sensor.flow.order": "cdab"}
    answers = conduct(tmp_path / "m.toml", Given(given, defaults=True), None, print)
    assert answers["sensor.flow.order"] == "CDAB"
    words = ["new", f"{tmp_path / 'm.toml'}", "--yes", "--bus=modbus-tcp", "--host=h", "--channels=flow"]
    assert main([*words, "--sensor=flow.order=acbd"]) == 2
    assert "is not one of ABCD, CDAB, BADC, DCBA" in capsys.readouterr().err


def test_bits_are_asked_of_a_word_only_and_written_as_the_file_has_them(tmp_path, capsys):
    asked_of = []

    def ask(question: Question) -> str:
        asked_of.append(question.key)
        texts = {"sensor.status.bits": "3", "sensor.alarm.register-type": "int16", "timeout-ms": "1500"}
        assert question.key in texts or question.default is not None, question.key
        return texts.get(question.key, f"{question.default}")

    given = {"host": "h", "bus": "modbus-tcp", "channels": "power, status, alarm", "limits": "none"}
    answers = conduct(tmp_path / "m.toml", Given(given, defaults=False), ask, print)
    assert [key for key in asked_of if key.endswith(".bits")] == ["sensor.status.bits"]
    machine = tomllib.loads(machine_text(answers, "m.toml"))
    assert only_bus(machine)["timeout_ms"] == 1500.0
    channels = only_stream(machine)["layout"]["channels"]
    assert [channel.get("bits") for channel in channels] == [None, [3, 1], None]
    words = ["new", f"{tmp_path / 'm.toml'}", "--yes", "--overwrite", "--bus=modbus-tcp", "--host=192.0.2.10"]
    assert main([*words, "--channels=power", "--sensor=power.bits=4-7"]) == 0
    assert "bits = [4, 4]" in (tmp_path / "m.toml").read_text()
    for wrong, why in (
        ("7-4", "is no bit: write its number"),
        ("x", "is no bit"),
        ("16", "are no part of uint16"),
    ):
        assert main([*words, "--channels=power", f"--sensor=power.bits={wrong}"]) == 2
        assert why in capsys.readouterr().err
    assert main([*words, "--timeout-ms=0"]) == 2
    assert "--timeout-ms 0: buses.modbus.timeout_ms = 0.0: must be 1 or more" in capsys.readouterr().err


@pytest.mark.parametrize("bus", ["can-dbc", "can"])
def test_an_interface_that_python_can_does_not_know_is_refused_at_once(tmp_path, capsys, bus):
    words = [f"--bus={bus}", "--interface=unixbsu", "--yes"]
    assert main(["new", f"{tmp_path / 'm.toml'}", *words]) == 2
    said = capsys.readouterr().err
    assert (
        '--interface unixbsu: "unixbsu" is no interface that python-can knows. Remedy: did you mean' in said
    )
    assert '"unixbus"?' in said


@pytest.mark.parametrize("channels", ["rpm", "vibration, temperature"])
def test_what_a_sensor_can_measure_is_not_invented(tmp_path, channels):
    """Beyond that range no alarm acts: a danger alarm of a hot bearing would be suppressed."""
    file = tmp_path / "m.toml"
    words = ["--bus=modbus-tcp", "--host=192.0.2.10", f"--channels={channels}", "--limits=none"]
    assert main(["new", f"{file}", "--yes", *words]) == 0
    text = file.read_text()
    assert text.count(
        "# ok_between = [LEAST, GREATEST]    # from the sensor's data sheet: beyond, its"
    ) == len(channels.split(","))
    assert [sensor.ok_between for sensor in load_machine_file(file).sensors] == [None] * text.count("[[sens")


def test_answers_of_a_file_are_those_of_the_options(tmp_path, capsys):
    answers = tmp_path / "answers.toml"
    answers.write_text(
        'bus = "modbus-tcp"\nname = "Lüfter \\"7\\" \'süd\' 泵"\nhost = "::1"\nunit = 3\nspeed = -1480\n'
        'channels = ["de", "nde"]\nlimits = "iso"\nclass = "1-flexible"\n'
        'sensor.de.address = 17\nsensor.de.type = "trend"\nsensor.de.unit = "mm/s"\n'
        '[sensor.nde]\naddress = 0x20\nscale = 0.001\nunit = "mm/s"\n',
        encoding="utf-8",
    )
    file = tmp_path / "fan.toml"
    assert main(["new", f"{file}", "--answers", f"{answers}", "--yes", "--unit", "4"]) == 0
    machine = load_machine_file(file)
    assert machine.machine.description == "Lüfter \"7\" 'süd' 泵"
    assert machine.machine.name == "lufter-7-sud"
    assert machine.machine.speed_rpm == -1480.0
    layout = only_stream(tomllib.loads(file.read_text(encoding="utf-8")))["layout"]
    assert layout["unit"] == 4
    assert [(one["address"], one["scale"]) for one in layout["channels"]] == [(17, 1.0), (32, 0.001)]
    assert [alarm.alert for alarm in machine.alarms] == [7.1, 7.1]
    assert [sensor.ok_between for sensor in machine.sensors] == [None] * 2  # nobody has stated it
    assert main(["check", f"{file}"]) == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--bus", "modbus-tcp", "--name", "a"],
            "Modbus device: give --host; there is no terminal to ask at",
        ),
        ([], "give --bus, or --yes for virtual and all other defaults"),
        (["--yes", "--bus", "modbus"], '--bus modbus: "modbus" is not one of virtual, can-dbc, '),
        (["--yes", "--bus", "modbus"], "; did you mean modbus-tcp or modbus-rtu? [C22]"),
        (["--yes", "--bus", "canbus"], "; did you mean can? [C22]"),
        (
            [
                "--yes",
                "--bus=can",
                "--rate=500",
                "--sensor",
                "x.type=accelerometer",
                "--sensor",
                "x.bearing=6205",
            ],
            "--sensor x.bearing= is not asked for with these answers; bearings need ",
        ),
        (["--yes", "--bus=can", "--sensor", "x.angle=up"], "--sensor x.angle=up: "),
        (
            ["--yes", "--bus=can", "--sensor", "foo.unit=g"],
            "--sensor foo.unit= is not asked for with these answers; there is no channel foo; there are x, y",
        ),
        (
            ["--yes", "--home-assistant", "yes"],
            "--home-assistant is not asked for with these answers; it needs --b",
        ),
        (["--yes", "--bus=can", "--limits=none", "--alert=2"], "it needs --limits own"),
        (
            ["--yes", "--limits=iso", "--class=2-rigid"],
            "answers; probes on the shaft have no class: leave it out",
        ),
        (
            ["--yes", "--bus=modbus-tcp", "--host=10.0.0.1:502", "--tcp-port=503"],
            "--tcp-port 503: 10.0.0.1:502 names another port: leave one of the two out [C22]",
        ),
        (["--yes", "--bus=serial", "--port=COM3"], "or /dev/ttyUSB0"),
        (
            ["--yes", "--bus=can", "--id=0x123456789"],
            "Remedy: write the id of the frames, which candump shows",
        ),
        (["--yes", "--host", "a"], "--host is not asked for with these answers; it needs --bus modbus-tcp"),
        (
            ["--yes", "--bus=modbus-tcp", "--host=a", "--registers=4000-4100"],
            "--registers 4000-4100 is for --listen only; add --listen, or leave it out [C22]",
        ),
        (
            ["--yes", "--bus=serial", "--port=/dev/ttyS0", "--seconds=10"],
            "--seconds 10 is for --listen only; add --listen, or leave it out [C22]",
        ),
        (
            ["--yes", "--listen", "--bus=serial", "--port=/dev/ttyS0", "--seconds=0"],
            '--seconds 0: "0": give a time above 0, up to 3600 s, or auto [C22]',
        ),
        (
            ["--yes", "--listen", "--bus=serial", "--registers=4000-4100"],
            "--registers is not asked for with these answers; it needs --bus modbus-tcp or modbus-rtu [C22]",
        ),
        (
            ["--yes", "--listen", "--bus=modbus-tcp", "--host=a", "--registers=4100-4000"],
            "--registers 4100-4000: write FIRST-LAST from 0 to 65535, e.g. 1-10 [C22]",
        ),
        (
            ["--yes", "--listen", "--bus=modbus-tcp", "--host=a", "--registers=400101-400110"],
            "on the line they are 100-109: write 100-109, and --table holding [C22]",
        ),
        (
            ["--yes", "--bus=modbus-tcp", "--host=a", "--units=0-300"],
            "--units 0-300: write FIRST-LAST from 0 to 255, e.g. 1-10 [C22]",
        ),
        (
            ["--yes", "--bus=serial", "--port=/dev/ttyS0", "--channels=x"],
            "--channels is not asked for with these answers; write --columns instead",
        ),
        (["--yes", "--speed", "0"], '--speed 0: "0" is a shaft that stands still'),
        (["--yes", "--sensor", "x.kind=none"], "--sensor x.kind= is not asked for"),
        (["--yes", "--sensor", "x"], "write CHANNEL.TOPIC=ANSWER"),
        (["--yes", "--name", "\u6cf5"], "holds no letter from a to z"),
        (["--yes", "--bus=can-dbc", "--dbc=no.dbc"], "there is no file"),
        (["--yes", "--bus=can", "--rate=1e6"], "Remedy: correct the rates of the streams"),
        (
            ["--yes", "--bus=can", "--sensor=x.type=accelerometer", "--rate=2560", "--sensor=x.bearing=9999"],
            "9999",
        ),
    ],
)
def test_what_is_missing_or_wrong_is_said_in_one_line_and_nothing_is_written(
    tmp_path, capsys, monkeypatch, options, words
):
    monkeypatch.chdir(tmp_path)
    assert main(["new", *options]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_listening_to_what_cannot_be_heard_is_said_to_be_left_out(tmp_path, capsys):
    assert main(["new", f"{tmp_path / 'rig.toml'}", "--yes", "--bus=virtual", "--listen"]) == 0
    assert (
        "--listen is left out: on a bus of this kind there is nothing to listen to" in capsys.readouterr().out
    )


def test_a_file_that_is_there_is_written_over_only_if_that_is_said(tmp_path, capsys):
    file = tmp_path / "rig.toml"
    file.write_text("mine")
    assert main(["new", f"{file}", "--yes"]) == 2
    assert "is there already; give another FILE, or --overwrite" in capsys.readouterr().err
    assert file.read_text() == "mine"
    assert main(["new", f"{file}", "--yes", "--overwrite"]) == 0
    assert load_machine_file(file).machine.name == "rig"
    assert main(["new", f"{tmp_path}", "--yes"]) == 2
    assert "is a directory; name a file in it" in capsys.readouterr().err
    assert main(["new", f"{tmp_path / 'no' / 'rig.toml'}", "--yes"]) == 2
    assert "make it first: mkdir -p" in capsys.readouterr().err


def test_a_dbc_file_is_found_from_where_it_was_typed_and_by_the_service_too(tmp_path, monkeypatch):
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    shutil.copy(DBC, here / "my sensor.dbc")
    monkeypatch.chdir(here)
    for file in (Path("fan.toml"), there / "fan.toml"):
        assert main(["new", f"{file}", "--yes", "--bus=can-dbc", "--dbc=my sensor.dbc"]) == 0
        machine = load_machine_file(file)
        assert [(one.name, one.type, one.unit) for one in machine.sensors] == [
            (f"accel-Accel{axis}", "accelerometer", "g") for axis in "XYZ"
        ]
    assert 'dbc = "my sensor.dbc"' in Path("fan.toml").read_text(encoding="utf-8")


class Terminal:
    """``daqsvc new`` at a terminal, in a folder."""

    def __init__(self, folder: Path, *options: str) -> None:
        self._leader, follower = pty.openpty()
        command = [sys.executable, "-m", "daqsvc", "new", *options]
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}"}
        self.process = subprocess.Popen(
            command, cwd=folder, stdin=follower, stdout=follower, stderr=follower, env=environment,
            start_new_session=True,
        )  # fmt: skip
        os.close(follower)

    def until(self, words: str) -> str:
        """What has come since the last look, up to some words."""
        seen = ""
        while words not in seen:
            try:
                seen += os.read(self._leader, 1).decode("utf-8", "replace")
            except OSError:
                raise AssertionError(f"it has ended without {words!r}: {seen}") from None
        return seen

    def type(self, text: str) -> None:
        os.write(self._leader, f"{text}\n".encode())

    def interrupt(self) -> None:
        """Press Ctrl-C; again where the prompt was shown and nothing was read yet: Python misses that one."""
        while self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=10)  # a second one while it ends would end it by the signal

    def rest(self) -> str:
        seen = ""
        try:
            while part := os.read(self._leader, 4096):
                seen += part.decode()
        except OSError:
            pass
        self.process.wait(timeout=60)
        os.close(self._leader)
        return seen


def test_at_a_terminal_it_explains_asks_again_and_takes_defaults(tmp_path):
    (tmp_path / "pump-3.toml").write_text("mine")
    terminal = Terminal(tmp_path)
    terminal.until("[virtual]: ")
    terminal.type("?")
    assert "daqsvc sim then plays a machine" in terminal.until("[virtual]: ")
    terminal.type("modbus")
    assert '"modbus" is not one of virtual, can-dbc' in terminal.until("[virtual]: ")
    terminal.type("")
    terminal.until("[rig]: ")
    terminal.type("Pump 3")
    terminal.until("pump-3.toml is there already. Another name, or overwrite: ")  # not behind all questions
    terminal.type("pump.toml")
    assert "zones of ISO 20816-3" in terminal.until("[own]: ")
    terminal.type("")
    assert "Alert limit (rms of probe-x, probe-y in um)" in terminal.until("[35]: ")
    terminal.type("-5")
    assert "must be greater than 0" in terminal.until("[35]: ")
    terminal.type("50")
    terminal.until("[75]: ")
    terminal.type("")
    terminal.until("[none]: ")
    terminal.type("")
    assert "daqsvc run pump.toml" in terminal.rest()
    assert terminal.process.returncode == 0
    machine = load_machine_file(tmp_path / "pump.toml")
    assert [(alarm.alert, alarm.danger) for alarm in machine.alarms] == [(50.0, 75.0), (50.0, 75.0)]
    assert (tmp_path / "pump-3.toml").read_text() == "mine"


def test_an_option_that_cannot_be_used_is_asked_for_at_a_terminal(tmp_path):
    terminal = Terminal(tmp_path, "rig.toml", "--speed", "0")
    terminal.until("[virtual]: ")
    terminal.type("")
    terminal.until("[rig]: ")
    terminal.type("")
    terminal.until('--speed 0: "0" is a shaft that stands still')
    terminal.until("[600]: ")
    terminal.type("1200")
    for _ in range(6):
        terminal.type("")
    terminal.rest()
    assert load_machine_file(tmp_path / "rig.toml").machine.speed_rpm == 1200.0


def test_a_wrong_answer_is_corrected_by_going_back(tmp_path):
    terminal = Terminal(tmp_path, "pump.toml")
    terminal.until("[virtual]: ")
    terminal.type("<")
    terminal.until("this is the first question")
    terminal.until("[virtual]: ")
    terminal.type("modbus-tcp")
    terminal.until("[machine]: ")
    terminal.type("<")
    terminal.until("[virtual]: ")
    terminal.type("modbus-tcp")
    terminal.until("[machine]: ")
    terminal.type("Pmup")
    terminal.until(" : ")  # the host
    terminal.type("<")
    terminal.until("[machine]: ")
    terminal.type("Pump")
    terminal.until(" : ")
    terminal.type("127.0.0.1:5020")
    terminal.until("[500]: ")
    terminal.type("")
    terminal.until("[1]: ")
    terminal.type("")
    terminal.until("[values]: ")
    terminal.type("")
    terminal.until("[holding]: ")
    terminal.type("")
    terminal.until("[vibration, temperature]: ")
    terminal.type("speed")
    terminal.until("[1480]: ")
    for _ in range(12):
        terminal.type("")
    terminal.rest()
    text = (tmp_path / "pump.toml").read_text()
    machine = load_machine_file(tmp_path / "pump.toml")
    assert machine.machine.name == "pump"
    assert "tcp_port = 5020" in text
    assert 'host = "127.0.0.1"' in text
    assert machine.sensors[0].unit == "rpm"


def test_a_file_of_the_command_line_that_is_there_is_asked_about_first(tmp_path):
    (tmp_path / "rig.toml").write_text("mine")
    terminal = Terminal(tmp_path, "rig.toml")
    terminal.until("rig.toml is there already. Another name, or overwrite: ")
    terminal.type("overwrite")
    for _ in range(6):
        terminal.until("]: ")
        terminal.type("")
    terminal.rest()
    assert terminal.process.returncode == 0
    assert load_machine_file(tmp_path / "rig.toml").machine.name == "rig"


def test_ctrl_c_leaves_nothing_behind(tmp_path):
    terminal = Terminal(tmp_path, "rig.toml")
    terminal.until("[virtual]: ")
    terminal.type("")
    terminal.until("[rig]: ")
    terminal.interrupt()
    assert "interrupted; nothing was written" in terminal.rest()
    assert terminal.process.returncode == 1
    assert list(tmp_path.iterdir()) == []


def test_the_end_of_the_input_leaves_nothing_behind(tmp_path):
    terminal = Terminal(tmp_path, "rig.toml")
    terminal.until("[virtual]: ")
    terminal.type("\x04")
    assert "nothing was written" in terminal.rest()
    assert list(tmp_path.iterdir()) == []


def test_answers_that_fit_each_other_are_taken_whatever_comes_later():
    """No answer is refused because of the default of a later question: nobody would know what to change."""
    for bus in buses():
        answers = conduct(
            Path("m.toml"), Given({"bus": bus, **NEEDED_OF.get(bus, {})}, defaults=True), None, print
        )
        assert refusal(answers, Path("m.toml")) is None


def asked(texts: list[str], bus: str, **given: str) -> tuple[Answers, list[str], list[str | None]]:
    """Answers of somebody who types these texts at the registers, reasons given, and defaults shown there."""
    said: list[str] = []
    shown: list[str | None] = []

    def ask(question: Question) -> str:
        if question.key != "sensor.a.address":
            assert question.default is not None, question.key
            return question.default
        shown.append(question.default)
        return texts.pop(0) or f"{question.default}"

    beforehand = Given({"bus": bus, "host": "::1", "channels": "a", **given}, defaults=False)
    return conduct(Path("m.toml"), beforehand, ask, said.append), said, shown


def test_a_number_of_the_manual_is_asked_again_with_the_address_that_it_means():
    answers, said, shown = asked(["40017", ""], "modbus-tcp")
    assert answers["sensor.a.address"] == 16
    assert shown == ["0", "16"]
    assert "looks like a number of the manual, where registers begin at 40001: that is 16 here" in said[0]
    answers, said, _ = asked(["30001", "30001"], "modbus-tcp")
    assert answers["sensor.a.address"] == 30_001
    assert len(said) == 1
    assert asked(["30000"], "modbus-tcp")[1] == []


def test_a_number_of_the_manual_states_the_table_too():
    answers, said, _ = asked(["30017", ""], "modbus-tcp")
    assert (answers["table"], answers["sensor.a.address"]) == ("input", 16)
    assert "that is 16 here" in said[0]
    assert "Enter also takes input registers for the table" in said[0]
    answers, said, _ = asked(["40017", ""], "modbus-tcp", table="input")
    assert (answers["table"], answers["sensor.a.address"]) == ("holding", 16)
    # Whoever has such addresses means no other table.
    assert asked(["30017", "30017"], "modbus-tcp")[0]["table"] == "holding"


def test_check_names_the_table_of_such_a_number(tmp_path, capsys):
    words = ["--yes", "--bus=modbus-tcp", "--host=::1", "--channels=a", "--sensor=a.address=30017"]
    assert main(["new", f"{tmp_path / 'm.toml'}", *words]) == 0
    assert (
        'Remedy: write address = 16 and table = "input", as registers begin at 0' in capsys.readouterr().out
    )


def test_channels_of_two_tables_are_no_channels_of_one_stream():
    texts, said = iter(["7", "30017", ""]), []

    def ask(question: Question) -> str:
        if question.key in {"sensor.a.address", "sensor.b.address"}:
            return next(texts) or f"{question.default}"
        assert question.default is not None, question.key
        return question.default

    beforehand = Given({"bus": "modbus-tcp", "host": "::1", "channels": "a, b"}, defaults=False)
    answers = conduct(Path("m.toml"), beforehand, ask, said.append)
    assert answers["table"] == "holding"
    assert (
        "they are input registers, and the channels before holding registers: a stream reads one" in said[0]
    )


def test_a_block_whose_registers_are_input_registers_of_the_manual_is_read_as_such():
    texts = iter(["30001"])

    def ask(question: Question) -> str:
        assert question.default is not None, question.key
        return next(texts, question.default) if question.key == "block-id" else question.default

    beforehand = Given({"bus": "modbus-tcp", "host": "::1", "way": "waveform"}, defaults=False)
    answers = conduct(Path("m.toml"), beforehand, ask, lambda _reason: None)
    assert (answers["block-id"], answers["table"]) == (0, "input")


def test_whoever_has_such_addresses_is_asked_once_only():
    """The channel behind one at 30001 most likely has such an address, too: Enter must not take another."""
    answers, said, shown = asked(["30001", "30001"], "modbus-tcp", channels="a, b")
    assert (answers["sensor.a.address"], answers["sensor.b.address"]) == (30_001, 30_002)
    assert len(said) == 1
    assert shown == ["0", "0"]


@pytest.mark.parametrize(
    ("way", "key"),
    [
        ("waveform", "block-id"),
        ("waveform", "block-address"),
        ("ring", "count-address"),
        ("ring", "ring-address"),
        ("fifo", "fifo-address"),
        ("fifo", "acknowledge"),
    ],
)
def test_each_way_is_asked_to_its_end_and_a_number_of_the_manual_is_noticed(way, key):
    said: list[str] = []
    texts = iter(["40017"])

    def ask(question: Question) -> str:
        assert question.default is not None, question.key
        return next(texts, question.default) if question.key == key else question.default

    beforehand = Given({"bus": "modbus-tcp", "host": "::1", "way": way}, defaults=False)
    assert conduct(Path("m.toml"), beforehand, ask, said.append)[key] == 16
    assert len(said) == 1
    assert "that is 16 here" in said[0]


def test_a_register_that_another_channel_has_is_asked_again():
    texts, said = iter(["40", "40", "41", "41"]), []

    def ask(question: Question) -> str:
        if question.key in {"sensor.a.address", "sensor.b.address"}:
            return next(texts)
        if question.key == "sensor.a.register-type":
            return "uint32"
        assert question.default is not None, question.key
        return question.default

    beforehand = Given({"bus": "modbus-tcp", "host": "::1", "channels": "a, b"}, defaults=False)
    answers = conduct(Path("m.toml"), beforehand, ask, said.append)
    assert said == [
        'register 40 holds "a" already. Enter takes 42; type 40 again if both are in it',
        'register 41 holds "a" already. Enter takes 42; type 41 again if both are in it',
    ]
    assert answers["sensor.b.address"] == 41


@pytest.mark.parametrize(
    ("text", "rate"),
    [("500k", 500_000), ("1M", 1_000_000), ("33.3 kbit/s", 33_300), ("83333", 83_333), ("125 kBit", 125_000)],
)
def test_a_bit_rate_may_be_written_as_it_is_said(text, rate):
    assert bit_rate(text) == rate


@pytest.mark.parametrize("text", ["fast", "0.5", "-1", "500 kHz", "0x10"])
def test_what_is_no_bit_rate_is_told_how_one_is_written(text):
    with pytest.raises(ValueError, match=r"; write (it in bit/s, )?e.g. 500000 or 500k$"):
        bit_rate(text)


@pytest.mark.parametrize(
    ("read", "text", "value"),
    [
        (rate_hz, "10 Hz", 10.0),
        (rate_hz, "2560hz", 2560.0),
        (rate_hz, "1e3 samples/s", 1000.0),
        (speed_rpm, "1485 rpm", 1485.0),
        (speed_rpm, "-1485 1/min", -1485.0),
        (speed_rpm, "1485 U/min", 1485.0),
        (seconds_or_auto, "20 s", 20.0),
        (number_in("mm/s"), "2.8 mm/s", 2.8),
        (number_in("1"), "11", 11.0),
        (number_in("1"), "0.001", 0.001),
    ],
)
def test_the_unit_of_a_number_may_be_typed_behind_it(read, text, value):
    assert read(text) == value


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (rate_hz, "10 kHz"),
        (speed_rpm, "25 Hz"),
        (rate_hz, "Hz"),
        (number_in("mm/s"), "2 g"),
        (speed_rpm, "1481/min"),
    ],
)
def test_another_unit_behind_a_number_is_refused(read, text):
    with pytest.raises(ValueError, match=f'^"{text}" is not a number; write e.g. 0.5 or 1480$'):
        read(text)


@pytest.mark.parametrize(
    ("speed", "meant"),
    [(1.485, "1485"), (1.48, "1480"), (1.5, "1500"), (-2.955, "-2955"), (12.5, "12500")],
)
def test_a_point_between_thousands_of_a_speed_is_doubted_once(speed, meant):
    said, instead = doubt_of_speed(speed)
    assert instead == meant
    assert said.startswith(
        f"{speed:g} rpm is slow for a shaft, and the point is a decimal point here. Enter takes"
    )


@pytest.mark.parametrize("speed", [1485.0, 1485.5, 120.5, 12.0, 0.0123])
def test_a_speed_that_a_machine_has_is_not_doubted(speed):
    assert doubt_of_speed(speed) is None


def test_a_speed_with_a_point_between_thousands_is_asked_again():
    typed, offered, said = ["1.485", ""], [], []

    def ask(question: Question) -> str:
        if question.key != "speed":
            return f"{question.default}"
        offered.append(question.default)
        return typed.pop(0)

    answers = conduct(Path("m.toml"), Given({"bus": "can"}, defaults=False), ask, said.append)
    assert (answers["speed"], offered) == (1485.0, ["1480", "1485"])
    assert [one for one in said if one.startswith("1.485 rpm is slow for a shaft")]


def test_a_can_bus_is_asked_for_its_bit_rate_as_it_is_said(tmp_path):
    file = tmp_path / "m.toml"
    assert main(["new", "--yes", "--bus=can", "--bitrate=250k", f"{file}"]) == 0
    assert "\nbitrate = 250000" in file.read_text()


def test_names_without_commas_are_told_of(capsys):
    assert main(["new", "--yes", "--bus=modbus-tcp", "--host=::1", "--channels=vibration temp"]) == 2
    assert '"vibration temp" has no commas: write vibration, temp' in capsys.readouterr().err


def test_a_class_that_there_is_not_is_refused_with_those_that_there_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["new", f"{tmp_path / 'm.toml'}", "--bus=can", "--yes"]
    assert main([*words, "--class=3-soft"]) == 2
    assert '--class 3-soft: "3-soft" is not one of 2-rigid, 2-flexible, 1-rigid' in capsys.readouterr().err
    assert main([*words, "--limits=none", "--class=1-rigid"]) == 2
    assert "--class is not asked for with these answers; it needs --limits iso" in capsys.readouterr().err
    assert main([*words, "--limits=iso", "--class=1-rigid"]) == 2  # of probes, which are the default
    assert "probes on the shaft have no class: leave it out" in capsys.readouterr().err


def test_an_empty_answer_is_shown_in_quotes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["new", f"{tmp_path / 'm.toml'}", "--bus=modbus-tcp", "--host=h", "--listen", "--yes"]
    assert main([*words, "--registers", ""]) == 2
    assert "--registers '': write FIRST-LAST from 0 to 65535" in capsys.readouterr().err


def test_a_file_without_an_alarm_is_said_to_have_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "m.toml"
    words = ["new", f"{file}", "--bus=modbus-tcp", "--host=h", "--yes", "--overwrite", "--channels=r40"]
    floats = [*words, "--sensor=r40.register-type=float32"]
    assert main(floats) == 0
    assert (
        "No alarm is in it yet: write a table [[alarms]] in place of its comment on alarms, see "
        '"Alarms" in the documentation; or run daqsvc new again with --limits.' in capsys.readouterr().out
    )
    [sensor] = tomllib.loads(file.read_text("utf-8"))["sensors"]
    assert sensor["unit"] == "1"  # a float is no count
    assert main(words) == 0
    [sensor] = tomllib.loads(file.read_text("utf-8"))["sensors"]
    assert sensor["unit"] == "count"
    capsys.readouterr()
    assert main([*floats, "--limits=own", "--alert=3", "--danger=5"]) == 0
    assert "No alarm" not in capsys.readouterr().out


def test_the_help_on_a_channel_tells_its_types_apart() -> None:
    answers: Answers = {"bus": "can"}
    for question in questions(answers, Path()):
        answers.setdefault(question.key, question.read(question.default or NEEDED.get(question.key, "x")))
        if question.key.endswith(".type"):
            for kind in question.choices or {}:
                assert kind in question.topic.help or kind == "keyphasor"
            break
    else:
        pytest.fail("no channel was asked for")
