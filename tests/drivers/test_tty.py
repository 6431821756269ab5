"""Lines of real devices, parity and all, on pseudo-terminals, which have none."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import termios

import pytest
import serial
from support.bus_tables import line_layout, serial_bus
from support.clocks import QuickClock
from support.modbus_layouts import register, registers_layout
from support.modbus_lines import Rig, until

from drivers.base import BusPort, StreamSpec
from drivers.serial.driver import SerialDriver
from drivers.tty import Character, CharacterFormat, is_pseudo_terminal, why_not_open
from sim_hw.nodes.modbus_node import ModbusRtuServer
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.serial_node import PseudoTerminal

pytestmark = pytest.mark.integration
TREND = registers_layout(1, "input", [register("x", 0, "int16")])
LINE = line_layout(("seq", "x"), ("x",), counter="seq")


def told(caplog):
    return [record.message for record in caplog.records if "is a pseudo-terminal" in record.message]


@pytest.mark.parametrize("parity", [None, "odd"])  # even by default
async def test_modbus_units_on_a_pseudo_terminal_are_read_with_the_parity_of_the_real_line(
    parity, tmp_path, caplog
):
    unit = ModbusUnit()
    unit.put("input", 0, b"\0\7")
    server = ModbusRtuServer({1: unit}, tmp_path / "ttyUSB0")
    options = {"transport": "rtu", "serial_port": str(tmp_path / "ttyUSB0"), "timeout_ms": 100.0}
    rig = Rig(options | ({"parity": parity} if parity else {}), {"s": (TREND, 100.0)}, clock=QuickClock(10))
    with caplog.at_level(logging.WARNING):
        async with rig.running() as driver:
            for plugged in (1, 2):  # the second opening is another one for the warning, too
                server.start()
                seen = rig.counters("s").samples_received
                await until(lambda seen=seen: rig.counters("s").samples_received > seen + 3)
                server.stop()
                await until(lambda plugged=plugged: driver.link.losses == plugged)
    assert (rig.samples("s") == 7.0).all()
    (said,) = told(caplog)
    assert f"Modbus RTU bus 'mb' ({tmp_path / 'ttyUSB0'}) is a pseudo-terminal" in said
    assert f"instead of parity {parity or 'even'!r} and 8 data bits" in said


@pytest.mark.gives("B44")
async def test_a_serial_device_on_a_pseudo_terminal_is_opened_and_opened_again(tmp_path, caplog):
    blocks = []
    given = {"port": str(tmp_path / "port"), "framing": "lines", "parity": "even", "data_bits": 7}
    spec = StreamSpec("x", LINE, 100.0)
    driver = SerialDriver(serial_bus(**given), BusPort("ser0", [spec], QuickClock(10), blocks.append))
    with caplog.at_level(logging.WARNING), PseudoTerminal(tmp_path / "port") as cable:
        for _ in range(2):  # the C library fails at the second attempt to set what the first could not
            task = asyncio.create_task(driver.run())
            await until(lambda: driver.link.state == "up")
            before = driver.counters.bytes_received
            os.write(cable.fd, b"1,1\n")
            await until(lambda before=before: driver.counters.bytes_received == before + 4)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
    assert driver.counters.open_failures == 0
    assert len(told(caplog)) == 1
    assert "instead of parity 'even' and 7 data bits" in told(caplog)[0]


def test_what_a_pseudo_terminal_carries_anyway_is_not_talked_about(tmp_path, caplog):
    with PseudoTerminal(tmp_path / "port"):
        characters = CharacterFormat("serial port 'p'", Character(8, "none"))
        assert characters.on(tmp_path / "port") == Character(8, "none")
    assert not told(caplog)


def test_other_ports_are_opened_as_asked(tmp_path):
    asked = Character(7, "even")
    (tmp_path / "file").touch()
    for port in (tmp_path / "nothing", tmp_path / "file", "/dev/null", "socket://127.0.0.1:1"):
        assert not is_pseudo_terminal(port)
        assert CharacterFormat("serial port 'p'", asked).on(port) == asked


def test_a_pseudo_terminal_is_known_by_its_link(tmp_path):
    with PseudoTerminal(tmp_path / "port") as cable:
        assert is_pseudo_terminal(tmp_path / "port")
        assert termios.tcgetattr(cable.fd)
    assert not is_pseudo_terminal(tmp_path / "port")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
@pytest.mark.parametrize(
    ("code", "group", "mode", "said"),
    [
        (errno.EACCES, 20, 0o660, "permission denied; make the service's user a member of the group dialout"),
        (errno.EACCES, 4, 0o660, "permission denied; make the service's user a member of the group adm"),
        (errno.EACCES, 4_004, 0o660, "permission denied; make the service's user a member of the group 4004"),
        (errno.EACCES, 0, 0o600, "permission denied; its owner alone may open it (mode 0600, group root)"),
        (errno.EPERM, 20, 0o660, "not permitted: a sandbox keeps it away; allow it by DeviceAllow="),
    ],
)
def test_what_lets_a_port_of_somebody_else_be_opened_is_said(code, group, mode, said, tmp_path):
    port = tmp_path / "ttyUSB0"
    port.touch()
    port.chmod(mode)
    os.chown(port, 0, group)
    assert why_not_open(OSError(code, os.strerror(code)), str(port), "port").startswith(said)
    port.unlink()
    assert "permission denied; make" in why_not_open(PermissionError(errno.EACCES, "x"), str(port), "port")


def test_what_is_no_serial_port_is_said_with_the_remedy(tmp_path):
    (tmp_path / "ttyUSB0").write_text("")
    for port, kind in ((tmp_path / "ttyUSB0", "a file"), (tmp_path, "a directory")):
        with pytest.raises(serial.SerialException) as refused:
            serial.Serial(str(port))
        said = why_not_open(refused.value, str(port), "port")
        assert said == f"{port} is no serial port ({kind}); plug the device in, or correct port"


def test_a_device_that_is_no_serial_port_is_named() -> None:
    with pytest.raises(serial.SerialException) as refused:
        serial.Serial("/dev/null")
    said = why_not_open(refused.value, "/dev/null", "port")
    assert said == "/dev/null is no serial port (another device); plug the device in, or correct port"
