"""``daqsvc sniff serial`` on pseudo-terminals; they have no baud rate, see test_serial_recognise.py."""

from __future__ import annotations

import binascii
import contextlib
import errno
import functools
import json
import operator
import os
import signal
import struct
import subprocess
import sys
import threading
import time
import tomllib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import serial
from support.formats import fits
from support.only_table import names_in, only_bus, only_stream
from support.waiting import PATIENCE_S

from daqsvc.cli import main
from daqsvc.commands.new.command import _heard
from daqsvc.commands.new.interview import Given, conduct
from daqsvc.commands.new.machine_text import machine_text
from drivers.serial import ports, questions, sniff
from drivers.serial.framing import Pieces
from drivers.serial.heard import HeardOnSerial
from drivers.serial.lines import LineCodec
from drivers.serial.questions import SerialQuestions
from drivers.serial.recognise import recognised
from drivers.serial.recognise_lines import TextLines
from drivers.serial.settings import LineLayout
from drivers.serial.sniff_report import WAITING_S, Heard, Report, Tried
from drivers.serial.sniff_words import MUST_TURN
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytestmark = pytest.mark.integration
BEGIN = 'schema_version = 1\nsite = "lab"\nbox = "edge-1"\n\n[machine]\nname = "fan"\nspeed_rpm = 1480.0\n\n'


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[PseudoTerminal]:
    with PseudoTerminal(tmp_path / "ttyUSB0") as cable:
        yield cable


@pytest.fixture(autouse=True)
def _listens_briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    """What nobody waits for: these devices send many lines a second."""
    monkeypatch.setattr(questions, "_LISTEN_S", 0.6)


@contextlib.contextmanager
def talking(cable: PseudoTerminal, say: Callable[[int], bytes]) -> Iterator[None]:
    """Have the device send, every few milliseconds until this ends."""
    done = threading.Event()

    def talk() -> None:
        number = 0
        while not done.wait(0.004) and cable.plugged:
            with contextlib.suppress(OSError):
                number += cable.send(say(number))

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def line(number: int) -> bytes:
    return b"%d,%d.25,-1.5,%d\r\n" % (number, number % 7, 1000 - number % 3)


def frame(number: int) -> bytes:
    payload = number.to_bytes(4, "little") + bytes([number * 7 % 256, 1, number * 31 % 256, 2])
    return b"\xa5\x5a" + payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "big")


def figures(cable: PseudoTerminal, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6", "--json", *more]) == 0
    found: dict[str, Any] = fits("daqsvc sniff serial", json.loads(capsys.readouterr().out))
    return found


def check(tmp_path: Path, fragment: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What it proposes, after it has passed `daqsvc check` in a whole file."""
    machine = tmp_path / "machine.toml"
    machine.write_text(BEGIN + fragment)
    code = main(["check", f"{machine}"])
    said = capsys.readouterr()
    assert (code, said.err) == (0, "")
    return tomllib.loads(fragment)


def test_lines_are_shown_with_their_columns(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, line):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
    said = capsys.readouterr()
    assert "trying " in said.err
    assert "2e 32 35 2c 2d 31 2e 35 2c" in said.out
    assert '4 columns; separated by ","' in said.out
    rows = {
        row.split()[0]: row.split() for row in said.out.splitlines() if row[:2] in {"c1", "c2", "c3", "c4"}
    }
    assert rows["c1"][-1] == "counts"
    assert rows["c3"][1:5] == ["number", "-1.5", "-1.5", "-1.5"]
    assert 'framing = "lines"' in said.out


def test_a_counter_that_begins_again_after_999_is_not_proposed(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]
) -> None:
    def decimal(number: int) -> bytes:
        return b"%d,%d.25,-1.5\r\n" % ((850 + number) % 1000, number % 7)

    with talking(cable, decimal):
        found = figures(cable, capsys, "--seconds", "2")  # behind the first lines
    assert [(one["counts"], one["turns_at"]) for one in found["columns"]] == [
        (False, 1000),
        (False, None),
        (False, None),
    ]
    assert "\ncounter =" not in found["machine_file"]
    assert 'channels = [{ name = "c2" }, { name = "c3" }]' in found["machine_file"]
    proposed = on_port(found).proposals({})
    assert (proposed["counter"], proposed["sensor.c1.type"]) == ("none", "none")
    assert any("c1 begins again at 0 after 999" in line for line in on_port(found).lines)


def test_lines_with_neither_counter_nor_time_are_proposed_as_such(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, lambda number: b"%d.25\r\n" % (20 + number * 7 % 5)):
        found = figures(cable, capsys)
    read = check(tmp_path, found["machine_file"], capsys)["streams"]["lines"]["layout"]
    assert (read["line"], read["no_counter"]) == (["c1"], True)
    proposed = on_port(found).proposals({})
    assert (proposed["columns"], proposed["counter"]) == ("c1", "none")


def test_a_counter_whose_turn_was_not_seen_is_proposed_with_a_word(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, line):
        found = figures(cable, capsys)
    assert f'counter = {{ column = "c1" }}    # as far as it was seen: {MUST_TURN}' in found["machine_file"]
    assert f"  c1 counts lines; {MUST_TURN}" in on_port(found).lines


def padded(number: int) -> bytes:
    return b"%8d %8.3f %8.3f\n" % (number, number % 7 - 3.25, -1.5 * (number % 11))


def test_columns_padded_with_blanks_are_proposed_as_they_are(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, padded):
        found = figures(cable, capsys)
        new_layout = only_stream(new(cable, tmp_path / "new.toml"))["layout"]
    assert (found["score"], found["lines_damaged"], found["any_baud"]) == (0.95, 0, False)
    [stream] = check(tmp_path, found["machine_file"], capsys)["streams"].values()
    for layout in (stream["layout"], new_layout):
        assert layout["separator"] == " "
        assert layout["counter"]["column"] == "c1"
        assert [one["name"] for one in layout["channels"]] == ["c2", "c3"]


def test_no_baud_rate_is_named_where_all_of_them_come_out_alike(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sniff, "TRY_S", 0.2)
    monkeypatch.setattr(sniff, "BAUDS", (115_200, 9600, 2400))

    def spoilt(number: int) -> bytes:
        return line(number) if number % 3 else b"no line\r\n"

    with talking(cable, spoilt):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
        said = capsys.readouterr().out
        found = figures(cable, capsys)
    assert f"{cable.path} at any baud rate, 8N1: " in said
    assert "baud = 115_200    # as good as any: the port does not use it" in said
    assert (found["baud"], found["any_baud"], len(found["tried"])) == (115_200, True, 3)
    assert next(iter(on_port(found).lines)).startswith("any baud rate, 8N1: lines of text")
    check(tmp_path, found["machine_file"], capsys)


@pytest.mark.long
def test_what_it_proposes_for_lines_passes_check(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, line):
        found = figures(cable, capsys)
    assert (found["framing"], found["separator"], len(found["columns"])) == ("lines", ",", 4)
    tables = check(tmp_path, found["machine_file"], capsys)
    [bus], [stream] = tables["buses"].values(), tables["streams"].values()
    assert bus["port"] == f"{cable.path}"
    assert stream["layout"]["counter"]["column"] == "c1"
    assert [one["name"] for one in stream["layout"]["channels"]] == ["c2", "c3", "c4"]
    assert stream["rate_hz"] == pytest.approx(found["rate_hz"], rel=0.006)


@pytest.mark.long
def test_decimal_commas_are_told_and_can_be_read(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, lambda number: b"%d;0,%03d;-1,5\n" % (number, number % 900)):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
        said = capsys.readouterr().out
        found = figures(cable, capsys)
        new_layout = only_stream(new(cable, tmp_path / "new.toml"))["layout"]
    assert '3 columns; separated by ";"; numbers have a decimal comma' in said
    (row,) = [text.split() for text in said.splitlines() if text.startswith("c3")]
    assert row == ["c3", "number", "-1,5", "-1,5", "-1,5"]
    [stream] = check(tmp_path, found["machine_file"], capsys)["streams"].values()
    for layout in (stream["layout"], new_layout):
        assert (layout["separator"], layout["decimal"]) == (";", ",")
        assert layout["counter"]["column"] == "c1"
        assert [one["name"] for one in layout["channels"]] == ["c2", "c3"]


def test_two_machines_on_one_port_are_two_kinds_of_lines(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    def both(number: int) -> bytes:
        turn = number // 2
        return b"K1;%d;7.9\n" % turn if number % 2 else b"K2;%d;3.5;41.0\n" % turn

    with talking(cable, both):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
        said = capsys.readouterr().out
        found = figures(cable, capsys)
        file = new(cable, tmp_path / "new.toml")
    new_layout = only_stream(file)["layout"]
    heard, written = capsys.readouterr().out, (tmp_path / "new.toml").read_text("utf-8")
    assert "2 kinds of lines, by their first column: K" in said
    assert "are damaged" not in said
    streams = check(tmp_path, found["machine_file"], capsys)["streams"]
    assert {name: one["layout"]["prefix"] for name, one in streams.items()} == {"K1": "K1", "K2": "K2"}
    assert [len(streams[name]["layout"]["channels"]) for name in ("K1", "K2")] == [1, 2]
    # Each listens by itself: at a rate that is near the limit they may take them for other sensors.
    proposed, new_names = (
        {(bus, stream, name.removeprefix("accel-")) for bus, stream, name in names_in(one)}
        for one in (tomllib.loads(found["machine_file"]), file)
    )
    assert {name for _, _, name in proposed} == {"K1-c2", "K2-c2", "K2-c3"}
    assert new_names == {names for names in proposed if names[1] == "K2"}
    rates = [one["rate_hz"] for one in streams.values()]
    assert max(rates) < 1.1 * min(rates)
    assert new_layout["prefix"] == "K2", "the one with the most numbers"
    stated = "Lines that begin with K1 come, too. This file reads one kind of line"
    assert stated in heard
    assert stated in " ".join(line.removeprefix("# ") for line in written.splitlines())


def test_the_rate_is_that_of_the_clock_of_the_device_where_it_sends_one() -> None:
    data = b"".join(b"%d;1.5\n" % (251 * number) for number in range(40))
    # Few lines in little time: by their arrival the rate is 4 % off.
    heard = Heard(data, len(data), 0.0, 10.2, 0)
    found = Report("ttyUSB0", [], Tried(9600, "none", heard, recognised(data)), True).sniffed()
    assert found.figures["rate_hz"] == pytest.approx(1000 / 251, rel=1e-6)
    assert tomllib.loads(found.fragment)["streams"]["lines"]["rate_hz"] == pytest.approx(3.98)


def on_port(found: dict[str, Any]) -> HeardOnSerial:
    """What ``daqsvc new`` makes of figures."""
    return HeardOnSerial(found, SerialQuestions())


def heard_at(lines: list[tuple[float, bytes]], waiting: bytes = b"") -> Heard:
    """What a port brings when each of the lines comes at its time, behind what had been waiting in it."""
    data, marks = bytearray(waiting), [(len(waiting), 0.0)] if waiting else []
    for at_s, line in lines:
        data += line
        marks.append((len(data), at_s))
    return Heard(bytes(data), len(data), marks[0][1], marks[-1][1], 0, "", len(waiting), tuple(marks))


MESSAGE = b"WARN at 2145 code 8998\r\n"


@pytest.mark.parametrize("seconds", [3.0, 5.0])
@pytest.mark.parametrize(
    ("say", "waiting"),
    [
        (lambda n: b"P1 %d 1.%d\r\n" % (n, n % 7) + MESSAGE * (n % 7 == 3), b""),
        (lambda n: b"P1 1.%d\r\n" % (n % 7) + MESSAGE * (n % 7 == 3), b""),
        (lambda n: b"%d;1.%d\r\n" % (n * 101, n % 7) + MESSAGE * (n % 7 == 3), b""),
        (lambda n: b"1.%d;2.5\r\n" % (n % 7), b"1.5;2.5\r\n" * 9),
        (lambda n: b"1.%d;2.5\r\n" % (n % 7) if n % 9 else b"1.%d;2?5\r\n" % (n % 7), b""),
        (lambda n: b"%d;2.5\r\n" % n if n % 10 else b"", b""),
    ],
    ids=["counter", "neither", "time", "waiting", "damaged", "missing"],
)
def test_the_rate_is_that_of_the_lines_of_the_layout(
    say: Callable[[int], bytes], waiting: bytes, seconds: float
) -> None:
    heard = heard_at([(n * 0.101, say(n)) for n in range(1, int(seconds / 0.101))], waiting)
    found = Report("ttyUSB0", [], Tried(9600, "none", heard, recognised(heard.data)), True).sniffed()
    assert found.figures["rate_hz"] == pytest.approx(1 / 0.101, rel=0.005)


def swinging(number: int) -> bytes:
    """An acceleration and a temperature."""
    return b"%.3f;%.1f\r\n" % (0.5 * np.sin(1.7 * number), 38 + 0.3 * np.sin(9.1 * number))


@pytest.mark.parametrize(
    ("rate_hz", "kind"), [(50.0, "accelerometer"), (99.97, "accelerometer"), (10.0, "trend")]
)
def test_values_that_swing_about_0_are_taken_for_a_waveform(rate_hz: float, kind: str) -> None:
    heard = heard_at([(number / rate_hz, swinging(number)) for number in range(int(3 * rate_hz))])
    found = Report("ttyUSB0", [], Tried(9600, "none", heard, recognised(heard.data)), True).sniffed()
    types = [one["type"] for one in tomllib.loads(found.fragment)["sensors"]]
    assert types[0] == kind
    assert ("a guess by the values, which swing about 0" in found.fragment) == (rate_hz >= 30)
    assert [one["swings"] for one in found.figures["columns"]] == [True, False]
    proposed = on_port(found.figures).proposals({})
    assert proposed.get("sensor.c1.type", "trend") == kind
    assert "sensor.c2.type" not in proposed
    taken = {"sensor.c1.type": kind, "sensor.c2.type": "trend", "columns": ("c1", "c2"), "counter": None}
    notes = " ".join(on_port(found.figures).notes({"framing": "lines", "baud": 9600, **taken}, (), taken))
    assert ("c1: type and unit of the sensor are a guess by the values" in notes) == (kind != "trend")
    assert ("c1: the values swing about 0. A trend value is averaged" in notes) == (kind == "trend")


def test_the_rate_at_which_samples_are_a_waveform_does_not_turn_on_a_clock() -> None:
    heard = heard_at([(number / 99.97, b"1.%d\r\n" % (number % 7)) for number in range(300)])
    found = Report("ttyUSB0", [], Tried(9600, "none", heard, recognised(heard.data)), True).sniffed()
    assert [one["type"] for one in tomllib.loads(found.fragment)["sensors"]] == ["accelerometer"]


def slow_line(number: int) -> bytes:
    """As a device with a line a second sends it."""
    return b"%d.25 degC;2.%d mm/s\r\n" % (38 + number % 2, number % 7)


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[tuple[int, float]]]:
    """Have a port with a device of a line a second, at one of the baud rates or at any."""

    def at(its_baud: int | None, say: Callable[[int], bytes] = slow_line) -> list[tuple[int, float]]:
        noise, done = np.random.default_rng(3), []

        def listened(_port, baud, parity, seconds, _enough, _stop, longer=None) -> Tried:
            done.append((baud, seconds))
            seconds += 10.0 if longer is not None and longer(b"x" * 22) else 0.0
            lines = [(float(number), say(number)) for number in range(max(1, int(seconds)))]
            if its_baud not in {baud, None}:
                lines = [
                    (at_s, noise.integers(256, size=len(line), dtype=np.uint8).tobytes())
                    for at_s, line in lines
                ]
            heard = heard_at(lines)
            return Tried(baud, parity, heard, recognised(heard.data))

        monkeypatch.setattr(sniff, "_try", listened)
        return done

    return at


def test_a_slow_device_is_found_at_the_rate_whose_bytes_are_text(
    tries, capsys: pytest.CaptureFixture[str]
) -> None:
    done = tries(9600)
    assert main(["sniff", "serial", "ttyUSB0"]) == 0
    said = capsys.readouterr()
    assert done[-1] == (9600, sniff.SECONDS)
    assert "baud = 9_600\n" in said.out
    assert "9600    21     0               100 %  0.00" in said.out


@pytest.mark.parametrize("seconds", [(), ("--seconds", "10")])
def test_a_slow_device_on_a_port_without_a_rate_gets_no_rate(
    seconds: tuple[str, ...], tries, capsys: pytest.CaptureFixture[str]
) -> None:
    tries(None)
    assert main(["sniff", "serial", "ttyUSB0", *seconds]) == 0
    said = capsys.readouterr().out
    assert "ttyUSB0 at any baud rate, 8N1" in said
    assert "baud = 115_200    # as good as any: the port does not use it" in said


def test_too_few_bytes_at_all_rates_are_called_so_and_seconds_makes_the_tries_longer(
    tries, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(5)
    done = tries(None, lambda _: noise.integers(128, 256, size=12, dtype=np.uint8).tobytes())
    assert main(["sniff", "serial", "ttyUSB0"]) == 1
    error = capsys.readouterr().err
    assert "bytes come, but too few to judge the baud rate by: 12 at most at each" in error
    assert "neither lines" not in error
    assert len(done) == len(sniff.BAUDS)
    done.clear()
    assert main(["sniff", "serial", "ttyUSB0", "--seconds", "20"]) == 1
    said = capsys.readouterr().err
    assert "trying 11 rates again, for 20 s each; --seconds sets the time" in said
    assert done[11:] == [(baud, 20.0) for baud in sniff.BAUDS] + [(done[-1][0], 20.0)]
    assert "neither lines of text nor frames" in said


def test_words_for_no_number_are_no_kinds_of_lines() -> None:
    what = recognised(b"".join(b"%s,%d,2\n" % ((b"nan", b"---")[k % 2], k) for k in range(40))).what
    assert isinstance(what, TextLines)
    assert not what.others


def test_what_of_the_lines_is_no_sample_is_stated_on_the_terminal_and_in_both_files(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.8)

    def sends(number: int) -> bytes:
        if number % 20 == 13:
            return b"ERR 12\r\n"
        return b"%d,%s,ok\r\n" % (number, b"---" if number % 4 == 3 else b"%d.5" % (number % 7))

    with talking(cable, sends):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.8"]) == 0
        shown = capsys.readouterr().out
        file = new(cable, tmp_path / "new.toml")
        said = capsys.readouterr().out
    assert only_stream(file)["layout"]["channels"] == [{"name": "c2"}]
    table, fragment = " ".join(shown.split()).split("To begin a machine file")
    text = " ".join((tmp_path / "new.toml").read_text("utf-8").replace("\n# ", " ").split())
    for words in (
        'lines are not of this layout, e.g. "ERR 12": daqsvc counts such lines, and does not read them',
        'lines: "---" is there. Only these samples of it are missing.',
        'Column c3 is left out, as not every line has a number there, but e.g. "ok".',
    ):
        for place in (table, fragment.replace("# ", ""), said, text):
            assert words in place


@pytest.mark.parametrize("seconds", [1.0, 3.0, 5.0])
def test_the_baud_rate_for_a_port_without_one_is_the_same_however_long_it_listens(seconds: float) -> None:
    """`new` listens for a shorter time than `sniff`; what had been waiting in the port is not counted."""
    data = b"".join(b"%d.25\r\n" % (k % 7) for k in range(600))
    received, waiting = round(0.995 * 36_864 * seconds) + 40_000, 40_000
    heard = Heard(data, received, 0.0, seconds + WAITING_S, 0, waiting=waiting)
    report = Report("ttyACM0", [], Tried(9600, "none", heard, recognised(data)), False)
    assert report.sniffed().figures["baud"] == 460_800


def test_what_ends_a_line_is_in_the_file_of_new(cable: PseudoTerminal, tmp_path: Path) -> None:
    with talking(cable, lambda number: b"%d,2.5\r" % number):
        file = new(cable, tmp_path / "new.toml")
    assert only_bus(file)["delimiter"] == "\r"


def test_columns_without_a_name_get_no_limits_of_vibration(cable: PseudoTerminal, tmp_path: Path) -> None:
    with talking(cable, lambda number: b"%d,58.5\n" % number):
        file = new(cable, tmp_path / "new.toml", "--rate", "10")
    assert [one["unit"] for one in file["sensors"]] == ["1"]
    assert not any("zones" in one for one in file.get("alarms", []))


@pytest.mark.long
def test_damaged_lines_are_counted_and_a_stream_is_proposed(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(
        cable, lambda n: b"ERR sensor timeout\n" if n and n % 20 == 0 else b"%d,%d.5\n" % (n, n % 9)
    ):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.8"]) == 0
        said = capsys.readouterr().out
        found = figures(cable, capsys)
    assert ' lines are not of this layout, e.g. "ERR sensor timeout": daqsvc counts such lines' in said
    assert 0 < found["lines_damaged"] < 0.1 * found["lines_heard"]
    [stream] = check(tmp_path, found["machine_file"], capsys)["streams"].values()
    assert stream["layout"]["counter"]["column"] == "c1"


@pytest.mark.long
def test_the_share_of_frames_that_pass_is_told(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(number: int) -> bytes:
        sent = frame(number)
        sent = sent if number % 7 else sent[:4] + bytes([sent[4] ^ 1]) + sent[5:]
        return sent + (os.urandom(5) if number % 10 == 0 else b"")

    with talking(cable, say):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "1"]) == 0
        said = capsys.readouterr().out
        found = figures(cable, capsys)
    assert "12 bytes, of them 8 of payload; check ibm-3740, big endian, passes in 8" in said
    assert " % of the bytes are in no frame" in said
    assert (found["frame_length"], found["crc"]) == (12, "ibm-3740")
    assert found["frames_passing"] == pytest.approx(6 / 7, abs=0.04)


def test_a_guess_is_no_finding(cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]) -> None:
    with talking(cable, lambda _: b"\xaa" + os.urandom(11)):
        words = ["sniff", "serial", f"{cable.path}", "--seconds", "1", "--baud", "9600"]
        assert main(words) == 1
        said = capsys.readouterr()
        assert main([*words, "--json"]) == 1
        found = json.loads(capsys.readouterr().out)
    assert "most likely they are frames of 12 bytes behind aa, but a score of 0." in said.err
    assert "Frames behind" not in said.out
    assert "To begin a machine file" not in said.out
    assert (found["framing"], found["machine_file"]) == (None, "")


def test_too_few_bytes_are_no_verdict(cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]) -> None:
    with talking(cable, lambda number: b"T=21 C\n" if cable.listening and number < 2 else b""):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.5", "--baud", "9600"]) == 1
    assert (
        " bytes came, which are too few to tell what they are. Remedy: listen longer"
        in capsys.readouterr().err
    )


def slow(number: int) -> bytes:
    """A few lines a second."""
    time.sleep(0.15)
    return b"%d.25\r\n" % (20 + number % 7)


def test_a_device_that_sends_little_is_listened_to_longer(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, slow):
        layout = only_stream(new(cable, tmp_path / "new.toml", "--baud=9600"))["layout"]
        told = capsys.readouterr().out
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.4", "--baud", "9600"]) == 1
        short = capsys.readouterr().err
    assert layout["no_counter"] is True
    assert "trying" not in told  # the rate was given
    assert "in 0.6 s, which is little to judge by: listening for up to 20 s more; --seconds sets" in told
    assert "more; --seconds" not in short


def test_new_listens_as_long_as_it_is_told(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 60.0)
    with talking(cable, line):
        new(cable, tmp_path / "new.toml", "--baud=115200", "--seconds=0.5")
    told = capsys.readouterr().out
    assert f"listening to {cable.path} at 115200 bit/s for 0.5 s" in told
    note = "That c1 counts lines is a guess by the lines that came: see the device's manual."
    assert f"\n{note}\n" in told
    assert f"# {note}\n" in (tmp_path / "new.toml").read_text("utf-8")


def test_what_new_takes_by_rate_or_name_is_called_a_guess(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ["--baud=115200", "--columns=n, x, temp, z", "--rate=200"]
    with talking(cable, line):
        new(cable, tmp_path / "new.toml", *names)
        told = capsys.readouterr().out
        names += ["--sensor=x.type=trend", "--sensor=z.type=none", "--counter=n"]
        new(cable, tmp_path / "given.toml", *names)
    given = capsys.readouterr().out
    assert "x, z: type and unit of the sensor are a guess by the rate; see the device's manual." in told
    assert "Units that are a guess by the names of channels: temp (degC). See the device's" in told
    assert "guess by the rate" not in given
    assert "counts lines is a guess" not in given


def test_a_column_of_time_and_a_header_are_used(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    begin_s = time.monotonic()
    opened_s: list[float] = []

    def say(number: int) -> bytes:
        # What comes while the port is being opened is thrown away.
        if cable.listening and not opened_s:
            opened_s.append(time.monotonic())
        if not opened_s or time.monotonic() - opened_s[0] < 0.1:
            return b""
        head = b"" if number else b"t [ms];accel x;temp\n"
        return head + b"%d;%d.5;20.5\n" % (1000 * (time.monotonic() - begin_s), number % 5)

    with talking(cable, say):
        found = figures(cable, capsys, "--baud", "57600", "--seconds", "2")
    assert found["header"] is True
    tables = check(tmp_path, found["machine_file"], capsys)
    [bus], [stream] = tables["buses"].values(), tables["streams"].values()
    assert bus["baud"] == 57_600
    assert stream["layout"]["separator"] == ";"
    assert stream["layout"]["line"] == ["t-ms", "accel-x", "temp"]
    assert stream["layout"]["time"] == {"column": "t-ms", "unit": "ms"}


def test_what_it_proposes_for_frames_passes_check(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, frame):
        found = figures(cable, capsys)
    assert (found["framing"], found["sync_word"], found["crc"]) == ("sync", "a55a", "ibm-3740")
    assert found["payload_length"] == 8
    tables = check(tmp_path, found["machine_file"], capsys)
    [bus], [stream] = tables["buses"].values(), tables["streams"].values()
    assert (bus["sync_word"], bus["crc"]) == ("a55a", "ibm-3740")
    assert stream["layout"]["payload_length"] == 8
    assert stream["layout"]["counter"]["byte"] == 0
    assert stream["layout"]["counter"]["counts"] == "frames"
    assert stream["layout"]["byte_order"] in {"big", "little"}


def test_a_silent_port_and_noise_are_failures_that_say_what_to_check(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sniff, "TRY_S", 0.05)
    assert main(["sniff", "serial", f"{cable.path}"]) == 1
    said = capsys.readouterr()
    assert "no byte came. Remedy: check that the device is powered" in said.err
    noise = iter(os.urandom(1_000_000))
    with talking(cable, lambda _: bytes(next(noise) for _ in range(40))):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.3", "--baud", "9600"]) == 1
    said = capsys.readouterr()
    assert "they are neither lines of text nor frames of one length. Remedy: " in said.err
    assert "To begin a machine file" not in said.out


def test_a_port_that_is_pulled_ends_it_and_what_came_is_shown(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(number: int) -> bytes:
        if number == 100:
            cable.unplug()
        return line(number)

    with talking(cable, say):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "60", "--baud", "115200"]) == 1
    said = capsys.readouterr()
    assert "4 columns" in said.out
    assert f"{cable.path} was lost: " in said.err
    assert "Remedy: plug it in again" in said.err


def test_a_port_that_is_busy_absent_or_not_ours_is_one_line(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def said(port: object) -> str:
        assert main(["sniff", "serial", f"{port}"]) == 1
        words = capsys.readouterr().err.splitlines()[-1]
        assert words.startswith(f"daqsvc: {port} cannot be opened: ")
        return words

    with serial.Serial(f"{cable.path}", exclusive=True):
        assert "another program has it open; stop that program" in said(cable.path)
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    (by_id / "usb-Pico-if00").symlink_to(cable.path)
    monkeypatch.setattr(ports, "BY_ID", by_id)
    assert ports.lasting_name(f"{cable.path}") == f"{by_id}/usb-Pico-if00"
    words = said(tmp_path / "absent")
    assert "plug the device in, or correct the name" in words
    assert f"ports of this computer: {by_id}/usb-Pico-if00" in words

    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", refuse)
    assert "permission denied; " in (words := said(cable.path))
    assert "your user" in words


@pytest.mark.long
def test_ctrl_c_ends_it_early_and_shows_what_came(cable: PseudoTerminal) -> None:
    command = [sys.executable, "-m", "daqsvc", "sniff", "serial", f"{cable.path}", "--json"]
    with talking(cable, line):
        process = subprocess.Popen(
            [*command, "--seconds", "600"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            assert process.stderr is not None
            while not process.stderr.readline().startswith("listening to "):
                pass
            threading.Event().wait(0.5)  # time for some lines
            process.send_signal(signal.SIGINT)
            output, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.communicate()
    assert (process.returncode, said) == (0, "")
    assert len(json.loads(output)["columns"]) == 4


def new(cable: PseudoTerminal, file: Path, *more: str) -> dict[str, Any]:
    """The machine file of `daqsvc new --listen`, which check has accepted."""
    assert main(["new", f"{file}", "--yes", "--listen", "--bus=serial", f"--port={cable.path}", *more]) == 0
    return tomllib.loads(file.read_text("utf-8"))


def test_new_proposes_the_lines_that_it_hears(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with talking(cable, line):
        heard = new(cable, tmp_path / "heard.toml")
        named = new(cable, tmp_path / "named.toml", "--columns=n, vib, temp, load")
    said = capsys.readouterr().out
    assert "115200 bit/s, 8N1: lines of text" in said
    assert "4 columns\n" in said
    layout = only_stream(heard)["layout"]
    assert layout["line"] == ["c1", "c2", "c3", "c4"]
    assert layout["counter"] == {"column": "c1"}
    # What is known of a column is known by its place, whatever it is called.
    assert only_stream(named)["layout"]["counter"] == {"column": "n"}
    assert 50 < only_stream(heard)["rate_hz"] < 400


def test_a_port_that_brings_more_than_its_baud_rate_is_proposed_with_one_that_carries_it(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As devices do that are the USB port themselves."""
    monkeypatch.setattr(questions, "_LISTEN_S", 1.0)

    def many(number: int) -> bytes:
        return b"".join(
            b"%d,%d.25,-1.53125,10%d\n" % (one, one % 7, one % 3) for one in range(8 * number, 8 * number + 8)
        )

    words = "More bytes come than 115200 bit/s carry: the port does not use its baud rate"
    with talking(cable, many):
        file = new(cable, tmp_path / "fast.toml")
        said = capsys.readouterr().out
        found = figures(cable, capsys)
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
        assert words in capsys.readouterr().out
        slow = ["new", f"{tmp_path / 'slow.toml'}", "--yes", "--listen", "--bus=serial", "--baud=9600"]
        assert main([*slow, f"--port={cable.path}"]) == 2
    refused = capsys.readouterr().err
    assert words in said
    any_baud = f"baud = {only_bus(file)['baud']} is as good as any: the port does not use it."
    assert any_baud in said
    assert f"# {any_baud}\n" in (tmp_path / "fast.toml").read_text("utf-8")
    assert only_bus(file)["baud"] in {460_800, 921_600}
    assert 800 < only_stream(file)["rate_hz"] < 2100
    assert (found["any_baud"], found["overrun_baud"]) == (True, 115_200)
    proposed = check(tmp_path, found["machine_file"], capsys)
    assert proposed["buses"]["ttyUSB0"]["baud"] == found["baud"]
    assert (
        "samples a second were heard, which cannot be used: buses.ttyUSB0.baud = 9600: is too slow" in refused
    )


def test_new_leaves_out_the_columns_that_are_no_numbers(cable: PseudoTerminal, tmp_path: Path) -> None:
    with talking(cable, lambda number: b"$LOG;%d;ok;%d.5\r\n" % (number, number % 9)):
        layout = only_stream(new(cable, tmp_path / "log.toml"))["layout"]
    assert (layout["prefix"], layout["separator"]) == ("$LOG", ";")
    assert layout["line"] == ["c1", "c2", "c3"]
    assert layout["channels"] == [{"name": "c3"}]


def with_units(number: int) -> bytes:
    return b"%d,%d.5 mm/s,45.%d C,ok\r\n" % (number, number % 9, number % 3)


def test_units_behind_numbers_are_in_words_and_in_what_is_proposed(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with talking(cable, with_units):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
        said = capsys.readouterr().out
        found = figures(cable, capsys)
    rows = [text.split() for text in said.splitlines() if text[:3] in {"c2 ", "c3 "}]
    assert [row[-2:] for row in rows] == [["in", "mm/s"], ["in", "C"]]
    assert [one["unit"] for one in found["columns"]] == [None, "mm/s", "C", None]
    proposed = check(tmp_path, found["machine_file"], capsys)
    assert proposed["streams"]["lines"]["layout"]["channels"] == [
        {"name": "c2", "suffix": "mm/s"},
        {"name": "c3", "suffix": "C"},
    ]
    assert [(one["type"], one["unit"]) for one in proposed["sensors"]] == [
        ("velocity", "mm/s"),
        ("trend", "degC"),
    ]


@pytest.mark.parametrize(("rate", "kind"), [("200", "velocity"), ("10", "trend")])
def test_new_proposes_the_units_that_it_hears(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    rate: str,
    kind: str,
) -> None:
    with talking(cable, with_units):
        file = new(cable, tmp_path / "units.toml", "--rate", rate)
    assert "c2 is in mm/s, as the device writes it behind the number" in capsys.readouterr().out
    assert only_stream(file)["layout"]["channels"] == [
        {"name": "c2", "suffix": "mm/s"},
        {"name": "c3", "suffix": "C"},
    ]
    assert [(one["type"], one["unit"]) for one in file["sensors"]] == [(kind, "mm/s"), ("trend", "degC")]


def test_new_says_what_to_do_when_it_hears_nothing(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sniff, "TRY_S", 0.01)
    for port, words in (
        (f"{cable.path}", "no byte came. Remedy: check that the device is powered"),
        ("/dev/ttyS99", "there is no /dev/ttyS99"),
    ):
        file = tmp_path / "silent.toml"
        assert main(["new", f"{file}", "--yes", "--listen", "--bus=serial", f"--port={port}"]) == 1
        said = capsys.readouterr().err
        assert said.startswith("daqsvc new: nothing was written: ")
        assert words in said
        assert not file.exists()


def test_new_reads_lines_that_only_have_what_is_measured(cable: PseudoTerminal, tmp_path: Path) -> None:
    file = tmp_path / "no-counter.toml"
    with talking(cable, lambda number: b"1.%d mm/s, 45.%d C\r\n" % (number * 7 % 10, number * 3 % 10)):
        assert main(["new", f"{file}", "--yes", "--listen", "--bus=serial", f"--port={cable.path}"]) == 0
    (stream,) = tomllib.loads(file.read_text("utf-8"))["streams"].values()
    assert (stream["layout"]["line"], stream["layout"]["no_counter"]) == (["c1", "c2"], True)
    assert main(["check", f"{file}"]) == 0


def test_new_makes_no_counter_of_a_measured_column(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "No column is a number, such as 22.5 or NAME=22.5: JSON and hex are not read."
    file = tmp_path / "no-counter.toml"
    with talking(cable, lambda number: b'{"v":1.%d} 0x%02X\r\n' % (number * 7 % 10, number * 3 % 10 + 160)):
        assert main(["new", f"{file}", "--yes", "--listen", "--bus=serial", f"--port={cable.path}"]) == 1
        said = capsys.readouterr()
        heard = SerialQuestions().listen(
            {"port": f"{cable.path}"}, tmp_path, threading.Event(), lambda _line: None
        )
    assert words in said.err
    assert "Remedy: have the device send them [C20]" in said.err
    assert "\n  Found:\n" in said.out
    assert not file.exists()
    # A person is told the same, goes on, and finds it in the file.
    told: list[str] = []
    given = Given({"bus": "serial", "port": f"{cable.path}"}, defaults=False)
    answers = conduct(file, given, lambda _question: "", told.append, lambda *_: heard)
    assert words in told[0]
    assert answers["notes"][0] == f"What was heard does not fit this file: {told[0]}."


NAMED = {
    "neither counter nor time": (
        lambda n: b"V=1.%d T=%d\r\n" % (n * 7 % 10, 3 + n * 3 % 4),
        {"line": ["V", "T"], "no_counter": True},
        [{"name": "V", "prefix": "V="}, {"name": "T", "prefix": "T="}],
    ),
    "a counter": (
        lambda n: b"n=%d,x:1.%d\r\n" % (n, n * 7 % 10),
        {"line": ["n", "x"], "counter": {"column": "n", "prefix": "n="}},
        [{"name": "x", "prefix": "x:"}],
    ),
    "letters beyond ASCII": (
        lambda n: f"{n},4{n * 7 % 10}.5°C\r\n".encode("latin-1"),
        {"line": ["c1", "c2"], "counter": {"column": "c1"}},
        [{"name": "c2", "suffix": "°C"}],
    ),
}


@pytest.mark.parametrize(("sends", "layout", "channels"), NAMED.values(), ids=NAMED)
def test_whoever_takes_all_defaults_gets_the_file_of_yes_and_it_reads_the_lines(
    cable: PseudoTerminal,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sends: Callable[[int], bytes],
    layout: dict[str, Any],
    channels: list[dict[str, str]],
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.8)
    with talking(cable, sends):
        file = new(cable, tmp_path / "new.toml", "--name=fan", "--rate=200")
        heard = SerialQuestions().listen(
            {"port": f"{cable.path}"}, tmp_path, threading.Event(), lambda _line: None
        )
    given = Given({"bus": "serial", "port": f"{cable.path}", "name": "fan", "rate": "200"}, defaults=False)
    named = tmp_path / "new.toml"
    answers = conduct(named, given, lambda _one: "", lambda _: None, lambda *_: heard)
    assert tomllib.loads(machine_text(answers, named.name)) == file
    written = only_stream(file)["layout"]
    assert {key: written[key] for key in layout} == layout
    assert written["channels"] == channels
    codec = LineCodec(LineLayout.model_validate({**written, "line": tuple(written["line"])}))
    sent = [sends(number).rstrip(b"\r\n") for number in range(20)]
    stops = np.cumsum([len(one) for one in sent])
    pieces = Pieces(np.frombuffer(b"".join(sent), np.uint8), np.append(0, stops[:-1]), stops, stops)
    assert codec.read(pieces).good.all()


def test_a_time_with_a_unit_behind_it_is_proposed_as_it_is(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 0.8)
    begin_s = time.monotonic()

    def sends(number: int) -> bytes:
        return b"t=%.2fms,%d.5 mm/s\r\n" % (1e3 * (time.monotonic() - begin_s), number * 7 % 9)

    with talking(cable, sends):
        found = figures(cable, capsys)
        file = new(cable, tmp_path / "new.toml")
    time_keys = {"column": "t", "unit": "ms", "prefix": "t=", "suffix": "ms"}
    proposed = check(tmp_path, found["machine_file"], capsys)
    assert proposed["streams"]["lines"]["layout"]["time"] == time_keys
    assert only_stream(file)["layout"]["time"] == time_keys


def test_new_proposes_no_counter_for_frames_without_one(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:

    def uncounted(number: int) -> bytes:
        payload = bytes([number * 7 % 256, 1, number * 31 % 256, 2, number * 57 % 256, 3])
        return b"\xa5\x5a" + payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "big")

    file = tmp_path / "no-counter.toml"
    with talking(cable, uncounted):
        assert main(["new", f"{file}", "--yes", "--listen", "--bus=serial", f"--port={cable.path}"]) == 1
    assert "A stream needs a counter: none was found in the 6 bytes of payload" in capsys.readouterr().err
    assert not file.exists()


def test_new_proposes_the_frames_that_it_hears(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 2.0)
    with talking(cable, frame):
        tables = new(cable, tmp_path / "frames.toml")
    assert "frames behind a55a of 12 bytes" in capsys.readouterr().out
    bus, stream = only_bus(tables), only_stream(tables)
    assert (bus["framing"], bus["sync_word"], bus["crc"]) == ("sync", "a55a", "ibm-3740")
    layout = stream["layout"]
    assert layout["payload_length"] == 8
    assert layout["counter"]["byte"] == 0
    assert layout["samples_per_frame"] == 1
    assert len(layout["channels"]) == (8 - layout["first_byte"]) // 2
    assert 50 < stream["rate_hz"] < 400


@pytest.mark.parametrize("text", ["T=0x%.0fF S=OK\n", '{"x":%.3f,"y":-0.352}\n'])
def test_why_text_without_numbers_gives_no_stream_is_stated(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    with talking(cable, lambda number: (text % (number % 7 + 0.25)).encode()):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
    assert "# No column is a number, such as 22.5 or NAME=22.5: JSON and hex" in capsys.readouterr().out


def test_the_file_states_that_the_driver_does_not_check_a_sum(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str]
) -> None:
    def summed(number: int) -> bytes:
        payload = number.to_bytes(2, "little") + bytes([number * 7 % 256, 1, number * 31 % 256, 2])
        return b"\xa5\x5a" + payload + bytes([sum(payload) % 256])

    with talking(cable, summed):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 0
    said = capsys.readouterr().out
    assert '# The driver does not check sum-8: a damaged frame is taken for a good one.\ncrc = "none"' in said


@pytest.mark.parametrize("has_check", [False, True])
def test_text_between_stx_and_etx_is_named_and_nothing_is_proposed(
    cable: PseudoTerminal, capsys: pytest.CaptureFixture[str], *, has_check: bool
) -> None:
    def enclosed(number: int) -> bytes:
        text = b"%04d;%+08.3f;%+08.3f\x03" % (number % 10_000, number % 7 - 3.5, number % 11 / 7)
        check = bytes([functools.reduce(operator.xor, text)]) if has_check else b""
        return b"\x02" + text + check

    with talking(cable, enclosed):
        assert main(["sniff", "serial", f"{cable.path}", "--seconds", "0.6"]) == 1
    out, err = capsys.readouterr()
    assert "text comes between the bytes 02 (STX) and 03 (ETX), which daqsvc does not read" in err
    assert "[buses." not in out


def modbus_frame(number: int) -> bytes:
    """A counter, two values, and the CRC of Modbus, which the driver does not know."""
    payload = struct.pack(
        "<Hhh", number % 65_536, number * 7919 % 3001 - 1500, number * 104_729 % 4001 - 2000
    )
    crc = 0xFFFF
    for byte in payload:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return b"\xaa\x55" + payload + crc.to_bytes(2, "little")


def test_of_frames_new_proposes_the_sensors_of_sniff(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 1.0)

    def slowly(number: int) -> bytes:
        time.sleep(0.02)
        return modbus_frame(number)

    with talking(cable, slowly):
        sniffed = tomllib.loads(figures(cable, capsys)["machine_file"])
        file = new(cable, tmp_path / "frames.toml")
    kinds = [(one["channel"], one["type"], one["unit"]) for one in file["sensors"]]
    assert kinds == [(one["channel"], one["type"], one["unit"]) for one in sniffed["sensors"]]
    assert names_in(file) == names_in(sniffed)
    [heard] = sniffed["streams"].values()
    assert only_stream(file)["layout"]["channels"] == heard["layout"]["channels"]


def test_of_frames_new_writes_no_limits_that_nobody_stated_and_names_the_guesses(
    cable: PseudoTerminal,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(questions, "_LISTEN_S", 1.0)
    with talking(cable, modbus_frame):
        file = new(cable, tmp_path / "frames.toml", "--rate=200")
        said = capsys.readouterr().out
        stated = new(cable, tmp_path / "stated.toml", "--rate=200", "--limits=iso")
    assert [(one["type"], one["unit"]) for one in file["sensors"]] == [("accelerometer", "g")] * 2
    assert "alarms" not in file
    assert len(stated["alarms"]) == 2
    text = (tmp_path / "frames.toml").read_text().replace("\n# ", " ")
    for words in (
        "c1, c2: type and unit of the sensor are a guess by the rate; see the device's manual.",
        "The driver does not check modbus: a damaged frame is taken for a good one.",
    ):
        assert words in said
        assert words in text


def test_a_port_that_was_not_opened_is_stated_at_the_end_and_in_the_file(
    cable: PseudoTerminal, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = Given({"bus": "serial", "port": f"{cable.path}"}, defaults=False)
    listen = functools.partial(_heard, tmp_path, person=True)
    with serial.Serial(f"{cable.path}", exclusive=True):
        answers = conduct(tmp_path / "m.toml", given, lambda _one: "", lambda _reason: None, listen)
    why = f"{cable.path} cannot be opened: another program has it open; stop that program"
    assert f"  The bus could not be listened to: {why}" in capsys.readouterr().out
    assert f"The bus could not be listened to; the channels are an example: {why}" in answers["notes"]
    text = machine_text(answers, "m.toml").replace("\n# ", " ")
    assert why in text
    assert "Nothing was heard" not in text
