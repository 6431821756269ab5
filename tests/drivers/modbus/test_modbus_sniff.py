"""``daqsvc sniff modbus`` against simulated devices: units, registers, gateways, and that it never writes."""

from __future__ import annotations

import asyncio
import functools
import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import tomllib
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest
from support.formats import fits
from support.only_table import names_in, only_stream
from support.ports import free_port
from support.waiting import PATIENCE_S

from daqsvc.cli import main
from daqsvc.commands.new.command import _heard
from daqsvc.commands.new.interview import BackError, Given, conduct
from daqsvc.commands.new.machine_text import machine_text
from drivers.modbus import questions, scan, sniff
from drivers.sniffing import SniffError
from sim_hw.nodes.modbus_node import ModbusRtuServer, ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from drivers.bus_questions import BusQuestions, Heard
    from drivers.questions import Answers, Question

pytestmark = pytest.mark.integration
BEGIN = 'schema_version = 1\nsite = "lab"\nbox = "edge-1"\n\n[machine]\nname = "fan"\nspeed_rpm = 1480.0\n\n'


@pytest.fixture(autouse=True)
def _without_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan, "ROUND_S", 0.0)


class Watched(ModbusUnit):
    """A unit that notes what it is asked, and whose value at 40 moves."""

    def __init__(self, code: int | None = None) -> None:
        super().__init__()
        self.asked: list[bytes] = []
        self._code = code
        self._count = 0

    def answer(self, pdu: bytes) -> bytes:
        self.asked.append(pdu)
        if self._code is not None:
            return bytes([pdu[0] | 0x80, self._code])
        self._count += 1
        self.put("holding", 40, struct.pack(">f", 23.37 + 1e-5 * self._count))
        return super().answer(pdu)


def pump() -> Watched:
    """Registers 0 to 3, 40 and 41, 107."""
    unit = Watched()
    unit.put("holding", 0, struct.pack(">4H", 7, 65_535, 300, 0))
    unit.put("holding", 107, struct.pack(">H", 5))
    return unit


@contextmanager
def serving(start: Callable[[], Any]) -> Iterator[Any]:
    """A simulated server on an event loop of its own; ``start`` is called there."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    async def begun() -> Any:
        server = start()
        if asyncio.iscoroutine(waits := server.start()):
            await waits
        return server

    async def ended(server: Any) -> None:
        server.stop()
        await asyncio.sleep(0.01)

    server = asyncio.run_coroutine_threadsafe(begun(), loop).result(PATIENCE_S)
    try:
        yield server
    finally:
        asyncio.run_coroutine_threadsafe(ended(server), loop).result(PATIENCE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@contextmanager
def tcp(units: Mapping[int, ModbusUnit]) -> Iterator[str]:
    with serving(lambda: ModbusTcpServer(units)) as server:
        yield f"127.0.0.1:{server.port}"


def words(target: str, *more: str) -> list[str]:
    return ["sniff", "modbus", target, "--pause-ms", "0", "--timeout-ms", "60", *more]


PATIENT = ("--timeout-ms", "5000")
"""Where all that is asked answers: no reply counts as missing, however busy the computer is."""


def figures(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found: dict[str, Any] = fits("daqsvc sniff modbus", json.loads(capsys.readouterr().out))
    return found


def test_units_and_registers_are_found_and_nothing_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    units = {3: pump(), 5: Watched(10), 6: Watched(11)}
    with tcp(units) as target:
        assert main(words(target, "--units", "1-8", "--registers", "0-120", "--json")) == 0
    found = figures(capsys)
    assert found["units"] == [3]
    assert found["units_gateway"] == [5, 6]
    [table] = found["tables"]
    assert table["runs"] == [[0, 3], [40, 41], [107, 107]]
    values = {one["address"]: one for one in table["registers"]}
    assert [values[k]["uint16"] for k in (0, 1, 2, 3, 107)] == [7, 65_535, 300, 0, 5]
    assert values[1]["int16"] == -1
    assert values[40]["later"] == values[40]["uint16"]
    assert values[41]["later"] != values[41]["uint16"]
    plausible = {
        (one["type"], one["order"]): one["value"] for one in values[40]["readings"] if one["plausible"]
    }
    assert plausible["float32", "ABCD"] == pytest.approx(23.4, abs=0.1)
    asked = [pdu for unit in units.values() for pdu in unit.asked]
    assert {pdu[0] for pdu in asked} == {3}
    assert found["requests"] == len(asked) + 5  # of addresses that nobody has


def test_registers_are_shown_and_what_it_proposes_passes_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({1: pump()}) as target:
        assert main(words(target, "--units", "1", "--function", "both")) == 0
        shown = capsys.readouterr()
        assert main(words(target, "--units", "1", "--json")) == 0
        fragment = figures(capsys)["machine_file"]
        assert main(words(target, "--units", "1", "--all-orders")) == 0
        everything = capsys.readouterr().out
    assert "for unit 1, at most 1 s; then for registers 0 to 200 of each one that answers" in shown.err
    assert "Unit 1, holding registers (function 3): 7 at 0-3, 40-41, 107" in shown.out
    assert "Unit 1, input registers (function 4): none" in shown.out
    rows = {line.split()[0]: line for line in shown.out.splitlines() if line[:3].strip().isdecimal()}
    assert rows["1"].split() == ["1", "ffff", "65535", "-1", "no", "value?"]
    assert "yes" in rows["41"]
    assert "float32 ABCD 23." in rows["40"]
    assert "*float32 ABCD 23." in everything
    assert "* marks the readings that look like quantities" in everything
    assert f"uint32 ABCD {65_535 * 65_536 + 300}" in everything
    assert "float32 DCBA" in everything
    machine = tmp_path / "machine.toml"
    machine.write_text(BEGIN + fragment.replace("127.0.0.1", "192.0.2.10"))
    code = main(["check", f"{machine}"])
    said = capsys.readouterr()
    assert (code, said.err) == (0, "")
    [stream] = tomllib.loads(fragment)["streams"].values()
    assert [(one["address"], one["type"]) for one in stream["layout"]["channels"]] == [
        (0, "uint16"),
        (1, "int16"),
        (2, "uint16"),
        (3, "uint16"),
        (40, "float32"),
        (107, "uint16"),
    ]


def test_registers_beyond_the_usual_ones_are_read_as_far_as_there_are_any(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unit = pump()
    for address, count in ((200, 2), (210, 1), (299, 3), (305, 1)):
        unit.put("holding", address, bytes(2 * count))
    with tcp({1: unit}) as target:
        assert main(words(target, "--units", "1", "--json")) == 0
        table, *_ = figures(capsys)["tables"]
        assert main(words(target, "--units", "1")) == 0
        on = capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "0-200")) == 0
        bounded = capsys.readouterr().out
    assert table["asked"] == [0, 300 + 100]
    assert table["runs"][-4:] == [[200, 201], [210, 210], [299, 301], [305, 305]]
    assert "Registers 0 to 400 were asked; --registers 0-800 looks further." in on
    assert "Registers 0 to 200 were asked, and 200 exists: --registers 0-400 looks further." in bounded


def test_reading_on_has_an_end(capsys: pytest.CaptureFixture[str]) -> None:
    unit = ModbusUnit()
    unit.map("holding", 0, 65_536)
    with tcp({1: unit}) as target:
        assert main(words(target, "--units", "1", "--json")) == 0
    assert figures(capsys)["tables"][0]["asked"] == [0, 1000]


def test_a_unit_with_many_registers_proposes_those_that_move_and_names_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unit = pump()
    unit.put("holding", 60, bytes(range(1, 21)))
    with tcp({1: unit}) as target:
        assert main(words(target, "--units", "1")) == 0
    shown = capsys.readouterr().out
    assert "address = 40" in shown
    assert "address = 60" not in shown
    assert "\n# left out, as they did not change: 0-3, 60-69, 107\n" in shown


@pytest.mark.parametrize(
    ("asked", "code", "said"),
    [
        (
            "40101-40110",
            1,
            "where holding registers begin at 40001; on the line they are 100-109. Remedy: write",
        ),
        (
            "30011-30012",
            1,
            "registers begin at 30001; on the line they are 10-11. Remedy: write --registers 10-11",
        ),
        ("400101-400110", 2, "registers begin at 400001; on the line they are 100-109. Remedy: write"),
        ("300001-300002", 2, "on the line they are 0-1. Remedy: write --registers 0-1 --function 4"),
    ],
)
def test_the_numbers_of_a_manual_are_translated(
    asked: str, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({1: pump()}) as target:
        assert main(words(target, "--units", "1", "--registers", asked)) == code
    assert said in capsys.readouterr().err


def test_the_numbers_of_a_manual_are_read_where_a_device_has_such_addresses(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unit = ModbusUnit()
    unit.put("holding", 40_100, bytes([0, 7]))
    with tcp({1: unit}) as target:
        assert main(words(target, "--units", "1", "--registers", "40100-40101")) == 0
    shown = capsys.readouterr().out
    assert "Registers 40100 to 40101 look like numbers of a manual" in shown
    assert "1 at 40100" in shown


class Ending(Watched):
    """A unit at which the person loses patience."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self._after = after

    def answer(self, pdu: bytes) -> bytes:
        if len(self.asked) == self._after:
            os.kill(os.getpid(), signal.SIGINT)
        return super().answer(pdu)


def test_what_was_not_read_is_not_called_absent(capsys: pytest.CaptureFixture[str]) -> None:
    units: dict[int, ModbusUnit] = {1: pump(), 2: Ending(after=4), 3: pump()}
    with tcp(units) as target:
        assert main(words(target, "--units", "1-3", "--registers", "0-9")) == 0
    shown = capsys.readouterr().out
    assert "units that answer: 1, 2, 3" in shown
    assert "Unit 1, holding registers (function 3): 4 at 0-3" in shown
    assert "Unit 3, holding registers (function 3): not read: ended before" in shown
    assert "Unit 2, holding registers (function 3): none so far\nRegister" in shown
    assert "Unit 3, holding registers (function 3): none" not in shown


def test_a_long_scan_says_how_far_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "TELL_S", 0.0)
    with tcp({2: pump()}) as target:
        assert main(words(target, "--units", "1-4", "--registers", "0-9")) == 0
    said = capsys.readouterr().err
    assert "asking unit 4, at most 1 s to go; units that answer: 2\n" in said
    assert "reading unit 2, holding registers (function 3) from 5 on, about 1 s to go\n" in said
    assert "reading unit 2, holding registers (function 3) again\n" in said


def test_replies_that_come_too_late_are_told_with_a_longer_time_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    late = lambda *_: PlannedReply(delay_ns=100_000_000)  # noqa: E731
    with serving(lambda: ModbusTcpServer({2: pump()}, plan=late)) as server:
        assert main(words(f"127.0.0.1:{server.port}", "--units", "1-5")) == 1
    said = capsys.readouterr().err
    assert (
        "no unit answers (units 1 to 5 were asked). Remedy: 1 reply came later than --timeout-ms 60: " in said
    )
    assert "write --timeout-ms 1000" in said


def test_input_registers_are_found_where_there_are_no_holding_registers(
    capsys: pytest.CaptureFixture[str],
) -> None:
    inputs, both = ModbusUnit(), pump()
    inputs.put("input", 2, struct.pack(">2H", 11, 12))
    both.put("input", 2, struct.pack(">2H", 21, 22))
    with tcp({1: inputs, 2: both}) as target:
        assert main(words(target, "--units", "1-2", "--registers", "0-9", "--json", *PATIENT)) == 0
    found = figures(capsys)
    tables = [(one["unit"], one["function"], one["runs"]) for one in found["tables"]]
    # Nothing of unit 2 moves, so its input registers are looked at, too.
    assert tables == [(1, 3, []), (1, 4, [[2, 3]]), (2, 3, [[0, 3]]), (2, 4, [[2, 3]])]
    streams = tomllib.loads(found["machine_file"])["streams"]
    assert streams["unit-1-input"]["layout"]["table"] == "input"


def test_a_server_that_ignores_the_unit_is_one_device(capsys: pytest.CaptureFixture[str]) -> None:
    unit = pump()
    with tcp(dict.fromkeys(range(1, 248), unit)) as target:
        assert main(words(target, "--registers", "0-9", *PATIENT)) == 0
    said = capsys.readouterr().out
    assert "It answers in the name of every unit, and alike" in said
    assert "only unit 1 was read; --units N reads unit N.\n" in said
    assert "units that answer: 1 (units 1 to 8 were asked)\n" in said
    assert len(unit.asked) < 60


def test_a_server_that_ignores_the_unit_is_one_device_although_its_value_moves(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with tcp(dict.fromkeys(range(1, 248), pump())) as target:
        assert main(words(target, "--registers", "41-42", "--json")) == 0
    found = figures(capsys)
    assert (found["units"], found["units_alike"], found["units_asked"]) == ([1], True, [1, 8])


def test_units_whose_values_differ_are_several_devices(capsys: pytest.CaptureFixture[str]) -> None:
    units = {unit: ModbusUnit() for unit in range(1, 11)}
    for unit, one in units.items():
        one.put("holding", 0, struct.pack(">H", 500 + unit // 5))
    with tcp(units) as target:
        assert main(words(target, "--units", "1-10", "--registers", "0-1", "--json")) == 0
    found = figures(capsys)
    assert (found["units"], found["units_alike"]) == (list(range(1, 11)), False)
    assert len([one for one in found["tables"] if one["function"] == 3]) == 10


def all_refuse_but(number: int, unit: ModbusUnit, code: int = 4) -> dict[int, ModbusUnit]:
    """A server that gives an exception for each unit that it does not have."""
    return {one: unit if one == number else Watched(code) for one in range(1, 248)}


@pytest.mark.parametrize("code", [2, 4])
def test_a_unit_is_found_where_the_server_refuses_all_others(
    code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = ModbusUnit()
    inputs.put("input", 0, struct.pack(">2H", 11, 12))
    for unit, function in ((pump(), 3), (inputs, 4)):
        with tcp(all_refuse_but(7, unit, code)) as target:
            assert main(words(target, "--units", "1-10", "--registers", "0-3")) == 0
        said = capsys.readouterr().out
        assert "units that answer: 7 (units 1 to 10 were asked)\n" in said
        assert f"Units 1-6, 8-10 all answer with exception {code}, " in said
        assert "they were not read; --units N reads unit N.\n" in said
        assert "every unit" not in said
        assert f"(function {function}): {4 if function == 3 else 2} at 0-" in said
    with tcp(all_refuse_but(7, pump(), code)) as target:
        assert main(words(target, "--registers", "0-3", "--json")) == 0
    found = figures(capsys)
    assert (found["units"], len(found["units_left_out"])) == ([7], 246)


def test_where_nothing_is_read_of_units_that_answer_alike_others_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with tcp(all_refuse_but(20, pump())) as target:
        assert main(words(target, "--units", "1-10", "--registers", "0-3")) == 1
    shown = capsys.readouterr()
    assert "It answers in the name of every unit, and alike" in shown.out
    assert "registers 0 to 3 of unit 1 were asked. Remedy: " in shown.err
    assert "and for its unit address (--units N), as others may have some" in shown.err


def test_new_finds_the_unit_where_the_server_refuses_all_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_UNITS", ("1-10", "11-22"))
    with tcp(all_refuse_but(7, Elsewhere())) as target:
        layout = only_stream(new(tmp_path, target, "--registers=4000-4020"))["layout"]
    assert (layout["unit"], layout["channels"][0]["address"]) == (7, 4000)
    said = capsys.readouterr().out
    assert "units that answer: 7 (units 1 to 10 were asked)" in said
    assert "the others from 1 to 10 all refuse with one exception, as if they were not there" in said
    with tcp(all_refuse_but(20, Elsewhere())) as target:
        layout = only_stream(new(tmp_path, target, "--registers=4000-4020"))["layout"]
        assert layout["unit"] == 20
        said = capsys.readouterr().out
        assert "none of units 1-10 has such registers: 11-22 are asked, too" in said
        line = [
            "new",
            f"{tmp_path / 'none.toml'}",
            "--yes",
            "--bus=modbus-tcp",
            f"--host={target}",
            "--listen",
        ]
        assert main([*line, "--registers=4000-4020", "--units=1-10"]) == 1
        shown = capsys.readouterr()
        assert "all answer alike, so only unit 1 was read: --units N reads unit N\n" in shown.out
        assert "e.g. 4000-4100; or name other units with --units" in shown.err
        assert main([*line, "--registers=4000-4020", "--units=1-20", "--unit=3"]) == 1
        assert "Unit 3 has refused, like most units. Remedy: correct --unit; " in capsys.readouterr().err


def test_units_that_answer_with_one_exception_only_share_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    units = {unit: pump() if unit == 3 else Watched(4) for unit in range(1, 6)}
    with tcp(units) as target:
        assert main(words(target, "--units", "1-5", "--registers", "0-9", *PATIENT)) == 0
    said = capsys.readouterr().out
    assert (
        "\nUnits 1, 2, 4, 5, holding registers (function 3): none; each answers with exception 4, server "
        "device failure\n" in said
    )
    assert said.count("exception 4") == 2  # by function 4, too
    assert "Unit 3, holding registers (function 3): 4 at 0-3" in said


def test_units_on_a_serial_line_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "ttyS0"
    with serving(lambda: ModbusRtuServer({2: pump()}, port)):
        # Two units are silent, so it cannot be patient; a reply may take half a second on a busy computer.
        asked = ("--units", "1-3", "--registers", "0-50", "--timeout-ms", "500")
        assert main(words(f"{port}", *asked, "--json")) == 0
    found = figures(capsys)
    assert (found["units"], found["tables"][0]["runs"]) == ([2], [[0, 3], [40, 41]])
    [bus] = tomllib.loads(found["machine_file"])["buses"].values()
    assert (bus["transport"], bus["serial_port"], bus["baud"]) == ("rtu", f"{port}", 19_200)


def test_a_port_may_be_named_by_where_it_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with serving(lambda: ModbusRtuServer({9: pump()}, tmp_path / "ttyS0")):
        assert main(words("ttyS0", "--units", "1")) == 1
    assert f"{tmp_path / 'ttyS0'}" in capsys.readouterr().err


def test_nobody_and_nothing_are_failures_that_say_what_to_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({9: Watched(11)}) as target:
        assert main(words(target, "--units", "8-9")) == 1
    said = capsys.readouterr().err
    assert "no unit answers (units 8 to 9 were asked); a gateway reports that no unit answers at 1" in said
    assert "compare the gateway's baud rate, parity and wiring" in said
    with tcp({9: pump()}) as target:
        assert main(words(target, "--units", "1")) == 1
    said = capsys.readouterr().err
    assert "check that 127.0.0.1 is the device's address and " in said
    assert "no firewall drops the requests" in said
    assert "baud" not in said
    with serving(lambda: ModbusRtuServer({9: pump()}, tmp_path / "ttyS0")):
        assert main(words(f"{tmp_path / 'ttyS0'}", "--units", "1")) == 1
    assert "baud rate and parity are its own, that A and B are not swapped" in capsys.readouterr().err
    with tcp({1: Watched(2)}) as target:
        assert main(words(target, "--units", "1", "--registers", "0-3")) == 1
    said = capsys.readouterr().err
    assert "no register could be read by function 3 and 4; registers 0 to 3 were asked. Remedy: " in said
    with tcp({1: Watched(2)}) as target:
        assert main(words(target, "--units", "1", "--registers", "0-3", "--function", "3")) == 1
    assert "for its addresses (--registers), and for its tables (--function both)" in capsys.readouterr().err
    assert main(words(f"127.0.0.1:{free_port()}")) == 1
    assert "nobody listens there; start the server, or correct TARGET" in capsys.readouterr().err
    assert main(words(f"{tmp_path / 'ttyS9'}")) == 1
    assert "plug the device in, or correct TARGET" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--units", "0-300"), "--units '0-300': write FIRST-LAST from 0 to 255"),
        (("--registers", "9-3"), "--registers '9-3': write FIRST-LAST"),
        (("--pause-ms", "-1"), "--pause-ms -1: give 0 to 10000 ms"),
        (("--timeout-ms", "0"), "--timeout-ms 0: must be "),
    ],
)
def test_wrong_arguments_are_one_line(
    more: tuple[str, str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sniff", "modbus", "127.0.0.1", *more]) == 2
    line = capsys.readouterr().err
    assert said in line
    assert len(line.splitlines()) == 1


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("127.0.0.1:99999", "TARGET '127.0.0.1:99999': the TCP port must be 65535 or less"),
        ("127.0.0.1:0", "TARGET '127.0.0.1:0': the TCP port must be 1 or more"),
        ("http://plc", "TARGET 'http://plc': write HOST, HOST:PORT or /dev/ttyS0"),
        ("a b", "TARGET 'a b': is no name or address of a host"),
    ],
)
def test_a_target_that_is_none_is_named_whole(
    target: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sniff", "modbus", target]) == 2
    assert said in capsys.readouterr().err


def test_ctrl_c_ends_it_early_and_shows_what_was_found() -> None:
    with tcp({1: pump()}) as target:
        command = [sys.executable, "-m", "daqsvc", "sniff", "modbus", target, "--json", "--timeout-ms", "100"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            assert process.stderr.readline().startswith("asking ")
            threading.Event().wait(0.5)  # unit 1 answers at once, the next ones never
            process.send_signal(signal.SIGINT)
            output, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.communicate()
    assert (process.returncode, said) == (0, "")
    assert json.loads(output)["units"] == [1]


@pytest.fixture
def _few_registers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sniff, "REGISTERS", "0-45")


def new(tmp_path: Path, target: str, *more: str) -> dict[str, Any]:
    """The machine file of `daqsvc new --listen`, which check has accepted."""
    file = tmp_path / "new.toml"
    host, _, port = target.rpartition(":")
    words = ["--bus=modbus-tcp", f"--host={host}", f"--tcp-port={port}", "--listen", "--overwrite", *more]
    assert main(["new", f"{file}", "--yes", *words]) == 0
    return tomllib.loads(file.read_text("utf-8"))


def not_written(tmp_path: Path, target: str, *more: str) -> int:
    """The exit code of the same where it writes no file."""
    file = tmp_path / "none.toml"
    code = main(["new", f"{file}", "--yes", "--bus=modbus-tcp", f"--host={target}", "--listen", *more])
    assert not file.exists()
    return code


def as_asked(tmp_path: Path, target: str, **given: str) -> tuple[Answers, list[str], dict[str, str | None]]:
    """Answers of a person who listens and types nothing but Enter, what is said, and the defaults shown."""
    said: list[str] = []
    shown: dict[str, str | None] = {}

    def ask(question: Question) -> str:
        shown[question.key] = question.default
        return ""

    listen = functools.partial(_heard, tmp_path, person=True)
    beforehand = Given({"bus": "modbus-tcp", "host": target, **given}, defaults=False)
    return conduct(tmp_path / "m.toml", beforehand, ask, said.append, listen), said, shown


@pytest.mark.long
@pytest.mark.usefixtures("_few_registers")
def test_new_proposes_the_registers_that_it_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unit = pump()
    with tcp({3: unit}) as target:
        tables = new(tmp_path, target)
        named = new(tmp_path, target, "--channels=speed, level, flow")
    said = capsys.readouterr().out
    assert "units that answer: 3 (units 1 to 10 were asked)" in said
    assert "unit 3 has holding registers 0 to 3, 40 to 41 (0 to 45 were asked; " in said
    assert "  40: 23.37" in said
    assert "as float32 ABCD, moves" in said
    layout = only_stream(tables)["layout"]
    assert (layout["unit"], layout["table"]) == (3, "holding")
    assert "  1: -1, no value?" in said
    assert [one.get("no_value") for one in layout["channels"]] == [None, 0xFFFF, None, None, None]
    assert [(one["name"], one["address"], one["type"]) for one in layout["channels"]] == [
        ("r0", 0, "uint16"),
        ("r1", 1, "int16"),
        ("r2", 2, "uint16"),
        ("r3", 3, "uint16"),
        ("r40", 40, "float32"),
    ]
    # Names of one's own: registers in a row as far as they are there.
    channels = only_stream(named)["layout"]["channels"]
    assert [(one["address"], one["type"]) for one in channels] == [(0, "uint16"), (1, "int16"), (2, "uint16")]
    assert all(pdu[0] in {3, 4} for pdu in unit.asked)


def test_new_says_what_it_had_not_read_when_it_was_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = questions.sniffed

    def ended(*arguments: Any) -> Any:
        found = whole(*arguments)
        return {**found, "tables": [{**one, "registers": []} for one in found["tables"]]}

    monkeypatch.setattr(questions, "sniffed", ended)
    with tcp({1: pump()}) as target:
        assert not_written(tmp_path, target, "--units=1", "--registers=0-50") == 1
    assert "the registers of unit 1 were not read yet when it was ended" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("_few_registers")
def test_new_asks_the_other_units_where_none_of_the_first_answers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_UNITS", ("1-2", "3-4"))
    with tcp({4: pump()}) as target:
        assert only_stream(new(tmp_path, target))["layout"]["unit"] == 4
    said = capsys.readouterr().out
    assert "none of units 1-2 answers: 3-4 are asked, too; Ctrl-C ends that" in said
    assert "units that answer: 4" in said
    assert "not asked" not in said


@pytest.mark.usefixtures("_few_registers")
def test_new_says_which_units_it_did_not_ask_and_asks_them_if_told_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_UNITS", ("1-2", "3-4"))
    with tcp({2: pump(), 4: pump()}) as target:
        assert only_stream(new(tmp_path, target))["layout"]["unit"] == 2
        said = capsys.readouterr().out
        new(tmp_path, target, "--units=1-4")
        more = capsys.readouterr().out
        assert (
            main(["new", f"{tmp_path / 'n.toml'}", "--yes", "--bus=modbus-tcp", "--host=h", "--units=a"]) == 2
        )
    assert "units that answer: 2 (units 1 to 2 were asked)" in said
    assert "units 3-4 were not asked: daqsvc new --listen --units 1-247 asks all" in said
    assert "units that answer: 2, 4" in more
    assert "not asked" not in more
    assert "write FIRST-LAST" in capsys.readouterr().err


class InputOnly(ModbusUnit):
    """A unit without holding registers, and with input registers beyond those that are asked."""

    def answer(self, pdu: bytes) -> bytes:
        return bytes([pdu[0] | 0x80, 2 if pdu[0] == 4 else 1])


@pytest.mark.usefixtures("_few_registers")
def test_new_proposes_the_unit_and_the_table_of_a_device_whose_registers_are_elsewhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for units in (("3-5", "6-7"), ("3-4", "5-6")):
        monkeypatch.setattr(questions, "_UNITS", units)
        with tcp({5: InputOnly()}) as target:
            answers, told, _ = as_asked(tmp_path, target)
            assert (answers["unit"], answers["table"]) == (5, "input")
            channels, reason, *_ = answers["notes"]
            assert channels == "None of these channels was heard on the bus; they are an example."
            assert reason.startswith("No register that was asked for is there. Remedy: ")
            said = capsys.readouterr().out
            assert "Nothing was found" not in said
            assert "unit 5 has no holding registers: it refuses function 3" in said
            assert "unit 5 answers for input registers, but has none of 0 to 45\n" in said
            assert "  Found:\n" in said
            assert "No register that was asked for is there. Remedy: write the addresses of its" in told[0]
            assert not_written(tmp_path, target) == 1
        assert f"daqsvc new: nothing was written: {told[0]} [C20]" in capsys.readouterr().err


@pytest.mark.usefixtures("_few_registers")
def test_new_writes_nothing_about_a_unit_that_did_not_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_UNITS", ("1-2", "3-4"))
    with tcp({2: pump()}) as target:
        assert not_written(tmp_path, target, "--unit=1", "--units=1-2") == 1
        assert not_written(tmp_path, target, "--unit=9", "--units=1-2") == 1
    said = capsys.readouterr().err
    assert "Unit 1 has not answered. Remedy: correct --unit; those that answer: 2 [C20]" in said
    assert "Unit 9 was not asked. Remedy: write --units 9, too; those that answer: 2 [C20]" in said


def test_new_looks_only_for_the_unit_that_is_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other, meant = pump(), pump()
    with tcp({2: other, 15: meant}) as target:
        tables = new(tmp_path, target, "--unit=15", "--registers=0-45")
        told = capsys.readouterr().out
        assert not_written(tmp_path, target, "--unit=9", "--registers=0-45") == 1
        refused = capsys.readouterr().err
        assert not_written(tmp_path, target, "--unit=x") == 2
    assert only_stream(tables)["layout"]["unit"] == 15
    assert "for unit 15, at most" in told
    assert "units that answer: 15 (unit 15 was asked)" in told
    assert "not asked" not in told
    assert other.asked == []
    assert "no unit answers (unit 9 was asked)" in refused
    assert "To see which other units answer, add --units 1-247 [C20]" in refused
    assert "daqsvc new: --unit x: " in capsys.readouterr().err


class Still(ModbusUnit):
    """A unit whose registers all stand still, from an address on."""

    def __init__(self, address: int, raw: bytes, *tables: str) -> None:
        super().__init__()
        for table in tables or ("holding",):
            self.put(table, address, raw)


def swapped(*values: float) -> bytes:
    """Numbers in the order CDAB."""
    raw = struct.pack(f">{len(values)}f", *values)
    return b"".join(raw[k + 2 : k + 4] + raw[k : k + 2] for k in range(0, len(raw), 4))


def test_floats_that_stand_still_are_proposed_as_such_and_called_a_guess(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({1: Still(20, swapped(23.45, 1.913, 48.21))}) as target:
        tables = new(tmp_path, target, "--unit=1", "--registers=20-30")
        told = capsys.readouterr().out
        new(
            tmp_path,
            target,
            "--unit=1",
            "--registers=20-30",
            "--channels=a",
            "--sensor=a.address=20",
            "--sensor=a.register-type=float32",
        )
    channels = only_stream(tables)["layout"]["channels"]
    assert [(one["address"], one["type"], one["order"]) for one in channels] == [
        (address, "float32", "CDAB") for address in (20, 22, 24)
    ]
    note = (
        "Type, byte order and scale of the registers are a guess by the values that were read: compare with"
    )
    assert f"\n{note} the device's register map.\n" in told
    assert "a guess" not in capsys.readouterr().out  # address and type were given


def test_what_was_read_of_a_channel_is_shown_with_its_register_and_is_in_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names of one's own are given registers in a row, whatever the names suggest."""
    beside: dict[str, str] = {}
    typed = {"channels": "vib, temp, speed"}

    def ask(question: Question) -> str:
        beside[question.key] = question.beside
        return typed.get(question.key, "")

    unit = Still(20, swapped(1.83, 2.19) + struct.pack(">2H", 2970, 0x8000))
    listen = functools.partial(_heard, tmp_path, person=True)
    with tcp({3: unit}) as target:
        given = Given(
            {"bus": "modbus-tcp", "host": target, "units": "3", "registers": "20-30"}, defaults=False
        )
        conduct(tmp_path / "m.toml", given, ask, lambda _reason: None, listen)
        capsys.readouterr()
        new(tmp_path, target, "--units=3", "--registers=20-30", "--channels=vib, temp, speed")
        told = capsys.readouterr().out
        own = "--sensor=off.no-value=0x8000"
        new(tmp_path, target, "--units=3", "--registers=25-30", "--channels=off, r26", own)
        absent = capsys.readouterr().out
        new(tmp_path, target, "--units=3", "--registers=20-30")
    assert beside["sensor.temp.address"] == "reads 2.19 as float32 CDAB"
    assert beside["sensor.speed.address"] == "reads 2970 as uint16"
    assert not beside["sensor.temp.register-type"]
    heard = "Heard: vib 1.83 mm/s (register 20); temp 2.19 degC (register 22); speed 2970 rpm (register 24)."
    guess = "Addresses that are a guess by the order of names: vib (20), temp (22), speed (24). Compare with"
    assert f"\n{heard}\n{guess} the device's register map.\n" in told
    assert "Heard: off no value (register 25).\nNo value was read of r26.\n" in absent
    # Names of registers say which ones they are.
    assert "order of names" not in capsys.readouterr().out
    assert "# Heard: r20 1.83 (register 20); r22 2.19" in (tmp_path / "new.toml").read_text("utf-8")


def test_units_that_the_file_does_not_read_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units = {3: Still(20, struct.pack(">2H", 5, 9)), 4: Still(20, struct.pack(">H", 7)), 5: ModbusUnit()}
    units[6] = Still(20, bytes(4))
    with tcp(units) as target:
        new(tmp_path, target, "--registers=20-30", "--units=1-8")
        several = capsys.readouterr().out
        new(tmp_path, target, "--registers=20-30", "--units=3")
    others = (
        "unit 4 (holding registers 20); unit 5 (no registers were found); unit 6 (holding registers 20 to "
    )
    proposes = "daqsvc sniff modbus --function both proposes a stream for each that has registers."
    assert f"\nNot read: {others}21, all 0). {proposes}\n" in several
    assert "Not read" not in capsys.readouterr().out
    with tcp({3: units[3], 4: units[4]}) as target:
        new(tmp_path, target, "--registers=20-30", "--units=3-4")
    assert "--function both proposes a stream for each.\n" in capsys.readouterr().out
    with tcp({3: units[3], 5: ModbusUnit()}) as target:
        new(tmp_path, target, "--registers=20-30", "--units=3-5")
    assert "\nNot read: unit 5 (no registers were found).\n" in capsys.readouterr().out


def test_where_no_holding_register_moves_sniff_names_the_input_registers(
    capsys: pytest.CaptureFixture[str],
) -> None:
    hint = "None of them moves: --function both reads the input registers of the unit, too.\n"
    unit = Still(0, struct.pack(">3H", 1, 19_200, 2), "holding", "input")
    with tcp({1: unit, 2: pump()}) as target:
        assert main(words(target, "--units", "1", "--registers", "0-9", "--function", "3", *PATIENT)) == 0
        assert hint in capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "0-9", "--function", "both", *PATIENT)) == 0
        assert main(words(target, "--units", "1", "--registers", "0-9", "--function", "4", *PATIENT)) == 0
        assert main(words(target, "--units", "2", "--registers", "40-45", *PATIENT)) == 0
    assert hint not in capsys.readouterr().out


def test_two_registers_that_may_be_one_float_are_not_halves_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    note = "Registers 20 and 21 may be one 32-bit number, e.g. a float32, and not two of 16 bits;"
    with tcp({1: Still(20, swapped(23.4517))}) as target:
        tables = new(tmp_path, target, "--unit=1", "--registers=20-30")
        told = capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "20-30", *PATIENT)) == 0
        shown = capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "20-30", "--json", *PATIENT)) == 0
    assert [one["type"] for one in only_stream(tables)["layout"]["channels"]] == ["uint16", "uint16"]
    assert "  20: 40213, or with 21 23.4517 as float32 CDAB" in told
    assert f"\n{note} values that stand still do not show it. See the device's" in told
    assert 'place of two: address = 20, type = "float32", order = "CDAB".' in told
    assert "# Registers 20 and 21 may be one 32-bit number" in (tmp_path / "new.toml").read_text("utf-8")
    assert "float32 CDAB 23.4517?" in shown
    assert shown.count("Registers 20 and 21 may be one 32-bit number") == 2  # and in the proposal
    table, _ = figures(capsys)["tables"]
    assert [(one["address"], one["order"]) for one in table["undecided"]] == [(20, "CDAB")]


def test_floats_with_exchanged_bytes_that_stand_still_are_not_halves_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = struct.pack(">3f", 1.8374, 2.2159, 63.2)
    badc = b"".join(raw[k : k + 2][::-1] for k in range(0, len(raw), 2))
    with tcp({1: Still(20, badc + struct.pack(">H", 0x8000))}) as target:
        tables = new(tmp_path, target, "--unit=1", "--registers=20-30")
        told = capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "20-30", *PATIENT)) == 0
        shown = capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "20-30", "--json", *PATIENT)) == 0
    assert "20: -5313, or with 21 1.8374 as float32 BADC" in told
    assert "Registers 20 and 21, 22 and 23, 24 and 25: each pair may be one 32-bit number" in told
    assert 'e.g. address = 20, type = "float32", order = "BADC".' in told
    assert "float32 BADC 2.2159?" in shown
    # Both propose the mark by which a register has no value.
    assert only_stream(tables)["layout"]["channels"][-1]["no_value"] == 0x8000
    assert 'name = "r26", address = 26, type = "uint16", no_value = 0x8000 },' in shown
    assert "[streams.unit-1.layout]    # types and no_value are a guess: see" in shown
    table, _ = figures(capsys)["tables"]
    assert [one["no_value"] for one in table["channels"]] == [None] * 6 + [0x8000]


def test_registers_are_read_again_for_as_long_as_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "ROUND_S", 0.1)
    unit = pump()
    with tcp({1: unit}) as target:
        begin_s = time.monotonic()
        new(tmp_path, target, "--unit=1", "--registers=40-41", "--seconds=1")
        took_s = time.monotonic() - begin_s
        rounds = sum(struct.unpack(">H", pdu[3:5]) == (2,) for pdu in unit.asked)
        assert main(words(target, "--seconds", "-1")) == 2
    assert "reading what is there again and again for 1 s; Ctrl-C ends it early" in capsys.readouterr().out
    assert took_s >= 1.0
    assert rounds > scan.ROUNDS


def test_zeros_beside_floats_may_be_floats_of_a_machine_at_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({1: Still(20, swapped(0.0, 0.0, 21.5))}) as target:
        new(tmp_path, target, "--unit=1", "--registers=20-30")
    told = capsys.readouterr().out
    assert "Registers 20 and 21, 22 and 23: each pair may be one 32-bit number" in told
    assert 'e.g. address = 20, type = "float32", order = "CDAB".' in told


def test_new_writes_nothing_of_a_device_whose_registers_are_all_0(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # One that answers 0 at any address has 30001, too, where a manual means input register 0.
    zeros = Still(0, bytes(2 * 8), "holding", "input")
    zeros.put("holding", 30_001, bytes(8))
    with tcp({1: zeros}) as target:
        assert not_written(tmp_path, target, "--unit=1") == 1
        refused = capsys.readouterr().err
        assert not_written(tmp_path, target, "--unit=1", "--registers=30001-30004") == 1
        manual = capsys.readouterr().err
        answers, told, shown = as_asked(
            tmp_path, target, unit="1", registers="0-3", table="input", limits="none"
        )
        new(tmp_path, target, "--unit=1", "--registers=0-3", "--table=input", "--channels=flow")
    assert (
        "All registers that were read are 0, and nothing shows where the values are. Remedy: switch"
        in refused
    )
    assert "or give --registers (and --table, holding or input) from its manual [C20]" in refused
    assert (
        "where input registers begin at 30001; on the line they are 0-3. Write --registers 0-3 --table"
        in manual
    )
    # Where the manual states the registers, it is right that they read 0 while the machine stands.
    assert (answers["table"], told) == ("input", [])
    note = "All registers that were read are 0: nothing shows that the values are there."
    assert note in answers["notes"]
    assert note in capsys.readouterr().out
    assert shown["channels"] == "r0, r1, r2, r3"


class Slow(Still):
    """Settings as holding registers; the input registers have a value that changes after some readings."""

    def __init__(self, readings: int = 0) -> None:
        super().__init__(0, struct.pack(">3H", 1, 19_200, 2))
        self.put("input", 0, struct.pack(">40H", 230, *range(1, 40)))
        self._readings = readings

    def answer(self, pdu: bytes) -> bytes:
        if pdu[0] == 4:
            self._readings -= 1
            self.put("input", 0, struct.pack(">H", 230 + (self._readings < 0)))
        return super().answer(pdu)


def test_where_all_holding_registers_stand_still_sniff_reads_the_input_registers_by_itself(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with tcp({1: Slow(readings=2), 2: pump()}) as target:
        assert main(words(target, "--units", "1-2", "--registers", "0-39", "--json", *PATIENT)) == 0
    tables = figures(capsys)["tables"]
    assert [(one["unit"], one["function"], one["moved"]) for one in tables[:2]] == [(1, 3, []), (1, 4, [0])]
    assert [(one["unit"], one["function"]) for one in tables[2:]] == [(2, 3), (2, 4)][: len(tables) - 2]


def test_a_value_that_changes_slowly_is_waited_for_and_what_stands_still_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The input registers are read five times as a rule; here they move after that."""
    with tcp({1: Slow(readings=5)}) as target:
        layout = only_stream(new(tmp_path, target, "--unit=1", "--registers=0-39"))["layout"]
    assert layout["table"] == "input"
    assert [one["address"] for one in layout["channels"]] == [0]
    said = capsys.readouterr().out
    assert "\nUnit 1 has holding registers, too; this file reads input registers.\n" in said
    assert "\nNot read of unit 1: input registers 1 to 39; of these none moved.\n" in said


def test_the_unit_whose_values_move_is_proposed_and_the_others_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({1: Still(0, struct.pack(">3H", 1, 19_200, 2)), 2: pump()}) as target:
        layout = only_stream(new(tmp_path, target, "--units=1-2", "--registers=0-45"))["layout"]
    assert layout["unit"] == 2
    assert "\nNot read: unit 1 (holding registers 0 to 2)." in capsys.readouterr().out


def test_of_two_tables_that_stand_still_the_input_registers_are_proposed_as_a_guess(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({1: Still(0, struct.pack(">3H", 1, 19_200, 2), "holding", "input")}) as target:
        layout = only_stream(new(tmp_path, target, "--unit=1", "--registers=0-9"))["layout"]
    assert layout["table"] == "input"
    assert "None of both moved: see the device's register map for which are measured." in (
        capsys.readouterr().out
    )


def test_the_table_whose_values_move_is_proposed_and_the_other_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Both(Still):
        def answer(self, pdu: bytes) -> bytes:
            self.count += 1
            self.put("input", 0, struct.pack(">2H", 230 + self.count % 7, 700))
            return super().answer(pdu)

        count = 0

    with tcp({1: Both(0, struct.pack(">3H", 1, 19_200, 2))}) as target:
        written = new(tmp_path, target, "--unit=1", "--registers=0-9")
        said = capsys.readouterr().out
        both = words(target, "--units", "1", "--registers", "0-9", "--function", "both", "--json", *PATIENT)
        assert main(both) == 0
    assert only_stream(written)["layout"]["table"] == "input"
    proposed = names_in(tomllib.loads(figures(capsys)["machine_file"]))
    assert {names[:2] for names in names_in(written)} == {("modbus", "unit-1-input")}
    assert ("modbus", "unit-1-input") in {names[:2] for names in proposed}
    assert "\nUnit 1 has holding registers, too; this file reads input registers.\n" in said


def test_tables_of_sniff_fit_below_a_file_of_new_whatever_tables_the_unit_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = Watched()
    both.put("input", 0, struct.pack(">4H", 2, 4, 6, 8))
    both.put("holding", 2, struct.pack(">2H", 1, 3))
    both.put("input", 40, struct.pack(">f", 12.5))
    with tcp({17: both}) as target:
        written = new(tmp_path, target, "--unit=17", "--registers=0-50", "--table=input")
        capsys.readouterr()
        asked = ("--units", "17", "--registers", "0-50", "--function", "both", "--json")
        assert main(words(target, *asked, "--timeout-ms", "300")) == 0
    proposed = tomllib.loads(figures(capsys)["machine_file"])
    assert proposed["buses"]["modbus"]["timeout_ms"] == written["buses"]["modbus"]["timeout_ms"] == 500.0

    def sensors(tables: dict[str, Any]) -> dict[tuple[str, str], tuple[str, str]]:
        return {(s["stream"], s["channel"]): (s["name"], s["unit"]) for s in tables["sensors"]}

    mine, others = sensors(written), sensors(proposed)
    assert {stream for stream, _ in mine} == {"unit-17-input"}
    assert {stream for stream, _ in others} == {"unit-17", "unit-17-input"}
    assert mine["unit-17-input", "r2"] == ("unit-17-input-r2", "count")
    assert mine["unit-17-input", "r40"] == ("unit-17-input-r40", "1")
    assert {key: others[key] for key in mine} == mine
    both_files = {**others, **mine}
    assert len({name for name, _ in both_files.values()}) == len(both_files)


class Elsewhere(ModbusUnit):
    """A unit whose values are beyond the registers that are read unless others are asked for."""

    def __init__(self) -> None:
        super().__init__()
        self._count = 0

    def answer(self, pdu: bytes) -> bytes:
        self._count += 1
        self.put("holding", 4000, struct.pack(">4f", 2.35, 61.5, 1480.0 + 0.01 * self._count, 0.87))
        self.put("input", 30_001, struct.pack(">2f", 2.35, 61.5))
        return super().answer(pdu)


def test_new_looks_at_the_registers_that_it_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tcp({3: Elsewhere()}) as target:
        holding = only_stream(new(tmp_path, target, "--units=3", "--registers=4000-4009"))["layout"]
        said = capsys.readouterr().out
        inputs = only_stream(new(tmp_path, target, "--units=3", "--registers=30001-30004"))["layout"]
        capsys.readouterr()
        assert not_written(tmp_path, target, "--units=3", "--registers=40001-40004") == 1
    assert "units that answer: 3 (unit 3 was asked)" in said
    assert "unit 3 has holding registers 4000 to 4007 (4000 to 4009 were asked; --registers looks" in said
    assert "  4002: 61.5 as float32 ABCD\n" in said  # the next number moves, this one does not
    assert said.count(", moves\n") == 1
    assert [(one["address"], one["type"]) for one in holding["channels"]] == [
        (address, "float32") for address in (4000, 4002, 4004, 4006)
    ]
    assert (inputs["unit"], inputs["table"]) == (3, "input")
    assert [(one["address"], one["type"]) for one in inputs["channels"]] == [
        (30_001, "float32"),
        (30_003, "float32"),
    ]
    shown = capsys.readouterr()
    assert "answers for holding registers, but has none of 40001 to 40004\n" in shown.out
    assert "on the line they are 0-3. Remedy: write --registers 0-3 --table holding [C20]\n" in shown.err


def test_registers_may_be_hexadecimal_as_in_many_register_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sniff.registers_of("0x1000-0x1030")[:2] == (4096, 4144)
    assert sniff.registers_of("0X1F")[:2] == (31, 31)
    assert sniff.registers_of("0-0x1F").end == 31
    for wrong in ("0x", "0xG0-0xH0", "1000-0x10", "0x10000", "1-2-3"):
        with pytest.raises(SniffError, match="write FIRST-LAST"):
            sniff.registers_of(wrong)
    with tcp({3: Elsewhere()}) as target:
        assert main(words(target, "--units", "0x3", "--registers", "0xFA0-0xFA9", *PATIENT)) == 0
        assert "Unit 3, holding registers (function 3): 8 at 4000-4007" in capsys.readouterr().out
        layout = only_stream(new(tmp_path, target, "--unit=3", "--registers=0xFA0-0xFA9"))["layout"]
        answers, _, shown = as_asked(tmp_path, target, unit="3", registers="0xFA0")
    assert [one["address"] for one in layout["channels"]] == [4000, 4002, 4004, 4006]
    assert (shown["channels"], answers["sensor.r4000.address"]) == ("r4000", 4000)


def test_at_a_terminal_it_asks_which_registers_and_going_back_asks_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever reads registers with numbers as in manuals has them in the device."""
    monkeypatch.setattr(sniff, "REGISTERS", "0-3")
    texts = {"registers": ["", "30001-30004", "30001-30004"], "unit": ["<", ""]}
    shown: list[tuple[str, str | None]] = []
    said: list[str] = []

    def ask(question: Question) -> str:
        shown.append((question.key, question.default))
        text = texts[question.key].pop(0) if question.key in texts else ""
        if text == "<":
            raise BackError
        return text

    def listen(bus: BusQuestions, answers: Answers) -> Heard:
        return bus.listen(answers, tmp_path, threading.Event(), lambda _line: None)

    with tcp({3: Elsewhere()}) as target:
        given = Given({"bus": "modbus-tcp", "host": target, "units": "3"}, defaults=False)
        answers = conduct(tmp_path / "m.toml", given, ask, said.append, listen)
    registers = [default for key, default in shown if key == "registers"]
    assert registers == ["auto", "auto", "0-3"]  # the numbers of a manual are doubted once
    assert said[0].startswith(
        "No register that was asked for is there. Remedy: write the addresses of its manual"
    )
    assert said[1] == "< goes back to correct an answer; then it listens again"
    assert "where input registers begin at 30001; on the line they are 0-3. Enter takes 0-3; type" in said[2]
    assert len(said) == 3
    assert [answers[f"sensor.{name}.address"] for name in answers["channels"]] == [30_001, 30_003]


class Both(ModbusUnit):
    """A unit with registers of both tables at the same addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.put("holding", 0, struct.pack(">3H", 1, 2, 3))
        self.put("input", 0, struct.pack(">3H", 231, 452, 1480))


def test_numbers_of_a_manual_of_input_registers_are_read_as_input_registers(tmp_path: Path) -> None:
    texts = ["30001-30003", ""]
    tables: list[str | None] = []

    def ask(question: Question) -> str:
        if question.key == "table":
            tables.append(question.default)
        return (texts.pop(0) if question.key == "registers" else "") or f"{question.default}"

    listen = functools.partial(_heard, tmp_path, person=True)
    with tcp({3: Both()}) as target:
        given = Given({"bus": "modbus-tcp", "host": target, "units": "3"}, defaults=False)
        answers = conduct(tmp_path / "m.toml", given, ask, lambda _reason: None, listen)
        option = new(tmp_path, target, "--units=3", "--registers=0-2", "--table=input")
    assert tables == ["input"]
    assert (answers["registers"], answers["table"]) == ("0-2", "input")
    assert [answers[f"sensor.{name}.address"] for name in answers["channels"]] == [0, 1, 2]
    assert only_stream(option)["layout"]["table"] == "input"


def test_without_listening_nobody_is_asked_for_registers_to_look_at(tmp_path: Path) -> None:
    asked: list[str] = []

    def ask(question: Question) -> str:
        asked.append(question.key)
        return f"{question.default}"

    given = Given({"bus": "modbus-rtu", "port": "/dev/ttyS0"}, defaults=False)
    conduct(tmp_path / "m.toml", given, ask, asked.append)
    assert "parity" in asked
    assert "registers" not in asked


def test_a_single_register_was_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with tcp({3: Elsewhere()}) as target:
        new(tmp_path, target, "--units=3", "--registers=4000")
        assert "unit 3 has holding registers 4000 (4000 was asked; " in capsys.readouterr().out
        assert main(words(target, "--units", "3", "--registers", "4000")) == 0
        assert "\nRegister 4000 was asked, and 4000 exists: " in capsys.readouterr().out
        assert main(words(target, "--units", "3", "--registers", "9")) == 1
        assert "; register 9 was asked. Remedy: " in capsys.readouterr().err


def test_units_may_be_a_list(capsys: pytest.CaptureFixture[str]) -> None:
    with tcp({3: pump(), 5: InputOnly(), 17: pump()}) as target:
        assert main(words(target, "--units", "5, 17", "--registers", "0-3", "--function", "both")) == 0
    shown = capsys.readouterr()
    assert "for units 5, 17, at most" in shown.err
    assert "units that answer: 5, 17 (units 5, 17 were asked)" in shown.out
    assert shown.out.count("Unit 5, holding registers (function 3)") == 1
    assert "Unit 5, holding registers (function 3): none\nrefused from 0 on: exception 1" in shown.out


@pytest.mark.usefixtures("_few_registers")
def test_new_says_what_to_do_when_nobody_answers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "_UNITS", ("1-1", "2-2"))
    nobody = f"127.0.0.1:{free_port()}"
    assert not_written(tmp_path, nobody) == 1
    assert "nobody listens there; start the server, or correct its address" in capsys.readouterr().err
    with tcp({9: pump()}) as target:
        assert not_written(tmp_path, target) == 1
    assert "no unit answers (unit 2 was asked). Remedy: check that 127.0.0.1 is" in capsys.readouterr().err
    answers, _, _ = as_asked(tmp_path, nobody)
    assert "  The bus could not be listened to: " in capsys.readouterr().out
    assert answers["channels"] == ("vibration", "temperature")
    text = machine_text(answers, "m.toml")
    begin = f"# The bus could not be listened to; the channels are an example: {nobody}: "
    assert begin in text
    assert "nobody listens there; start the server" in text.replace("\n# ", " ")
    # Whoever names the channels and their registers needs no such comment.
    own = {"channels": "a", "sensor.a.address": "7"}
    assert "example" not in machine_text(as_asked(tmp_path, nobody, **own)[0], "m.toml").partition("[")[0]


def test_new_waits_for_replies_as_long_as_was_answered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That the default was taken makes no difference."""
    monkeypatch.setattr(sniff, "REGISTERS", "0-0")
    late = lambda *_: PlannedReply(delay_ns=350_000_000)  # noqa: E731
    with serving(lambda: ModbusTcpServer({5: InputOnly()}, plan=late)) as server:
        assert not_written(tmp_path, f"127.0.0.1:{server.port}", "--units=5") == 1
    assert "units that answer: 5" in capsys.readouterr().out


def test_late_replies_of_the_first_search_are_stated_and_no_other_unit_is_looked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = lambda *_: PlannedReply(delay_ns=150_000_000)  # noqa: E731
    with serving(lambda: ModbusTcpServer({3: pump()}, plan=late)) as server:
        assert not_written(tmp_path, f"127.0.0.1:{server.port}", "--timeout-ms=60") == 1
    shown = capsys.readouterr()
    assert "11-247 are asked" not in shown.out
    assert re.search(
        r"Remedy: \d repl(y|ies) came later than --timeout-ms 60: write --timeout-ms 1000", shown.err
    )


def test_replies_that_come_too_late_are_stated_beside_units_that_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slow_unit = lambda unit, _pdu: PlannedReply(delay_ns=400_000_000 * (unit == 3))  # noqa: E731
    with serving(lambda: ModbusTcpServer({3: pump(), 8: pump()}, plan=slow_unit)) as server:
        target = f"127.0.0.1:{server.port}"
        new(tmp_path, target, "--timeout-ms=200", "--registers=0-3")
        told = capsys.readouterr().out
        assert main(words(target, "--units", "1-10", "--registers", "0-3", "--timeout-ms", "200")) == 0
    note = r"\d repl(y|ies) came later than --timeout-ms 200: write --timeout-ms 1000 to find what is missing"
    assert re.search(note, told)
    assert re.search(note, capsys.readouterr().out)


def test_new_proposes_a_unit_that_was_to_be_asked_although_it_does_not_answer(tmp_path: Path) -> None:
    answers, _, _ = as_asked(tmp_path, f"127.0.0.1:{free_port()}", units="15-18")
    assert answers["unit"] == 15


class Short(Watched):
    """A unit that answers for few registers at once."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most = most
        self.put("holding", 0, struct.pack(">10H", *range(5, 15)))

    def answer(self, pdu: bytes) -> bytes:
        answered = super().answer(pdu)
        return bytes([pdu[0] | 0x80, 3]) if int.from_bytes(pdu[3:5], "big") > self._most else answered


@pytest.mark.usefixtures("_few_registers")
@pytest.mark.parametrize("most", [1, 4, 7, 8])
def test_how_many_registers_a_unit_answers_for_at_once_is_found_and_proposed(
    most: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unit = Short(most)
    with tcp({1: unit}) as target:
        assert main(words(target, "--units", "1", "--registers", "0-45")) == 0
        said = capsys.readouterr().out
        assert main(words(target, "--units", "1", "--registers", "0-45", "--json")) == 0
        found = figures(capsys)
        layout = only_stream(new(tmp_path, target))["layout"]
    assert found["tables"][0]["max_count"] == most
    assert found["tables"][0]["runs"] == [[0, 9], [40, 41]]
    assert found["tables"][0]["moved"] == [41]
    assert f"Registers in a request: {most} at most (max_count)." in said
    assert f"\nmax_count = {most}    # it refuses requests of more registers" in said
    assert layout["max_count"] == most
    assert f"  registers in a request: {most} at most" in capsys.readouterr().out


class Valued(Watched):
    """A unit that refuses registers that it does not have as an illegal value."""

    def answer(self, pdu: bytes) -> bytes:
        answered = super().answer(pdu)
        return bytes([answered[0], 3]) if answered[0] & 0x80 else answered


def test_a_unit_that_refuses_registers_as_illegal_values_has_no_limit(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unit = Valued()
    unit.put("holding", 3, struct.pack(">6H", *range(5, 11)))
    with tcp({1: unit}) as target:
        assert main(words(target, "--units", "1", "--registers", "0-45", "--json")) == 0
    table, *_ = figures(capsys)["tables"]
    assert table["runs"] == [[3, 8], [40, 41]]
    assert table["max_count"] is None
