"""``daqsvc sniff modbus``: which units answer, which registers they have, and what those may mean."""

from __future__ import annotations

import asyncio
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drivers.sniffing import Sniffed, Sniffer, SniffError

if TYPE_CHECKING:
    import argparse
    import threading
    from collections.abc import Callable

    from drivers.modbus.settings import ModbusBus

TCP_PORT = 502
UNITS = "1-247"
REGISTERS = "0-200"
AUTO = "auto"
_FUNCTIONS = {AUTO: (3, 4), "3": (3,), "4": (4,), "both": (3, 4)}
LAST_REGISTER = 65_535
LONGEST_SECONDS = 3600.0
_LONG_MANUALS_FIRST = (300_001, 400_001)
"""What manuals with six digits call the first input register and the first holding register."""
_INPUT = (30_001, 300_001)
_FIRST_LAST = re.compile(r"(0x[0-9a-f]+|[0-9]+)(?:\s*-\s*(0x[0-9a-f]+|[0-9]+))?", re.IGNORECASE)
"""Decimal, or hexadecimal as in many register maps."""


class ModbusSniffer(Sniffer):
    """See `drivers.sniffing.Sniffer`."""

    help = "scan a Modbus server or line: units that answer, their registers, what those may mean"
    description = (
        "Read the registers of a Modbus TCP server, or of the units on a serial line, several times. "
        "Print which registers exist, which of them change, and which numbers they may be. It sends one "
        "request at a time, with a pause before each. Nothing is written to a device."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `drivers.sniffing.Sniffer.add_arguments`."""
        parser.add_argument(
            "target", metavar="TARGET", help="HOST[:PORT], or the path of a serial port, e.g. /dev/ttyUSB0"
        )
        parser.add_argument(
            "--units",
            default=UNITS,
            metavar="A-B",
            help=f"addresses of units to try, e.g. 1-10 or 5,17 (default: {UNITS})",
        )
        parser.add_argument(
            "--registers",
            metavar="A-B",
            help=f"addresses of registers to read, counted from 0, e.g. 0-99 or 0x1000-0x1030 (default: "
            f"{REGISTERS}, and on if the last one exists)",
        )
        parser.add_argument(
            "--function",
            choices=tuple(_FUNCTIONS),
            default=AUTO,
            help="function code: 3 reads holding registers, 4 input registers (default: auto: 3, and 4 for "
            "a unit without holding registers that move)",
        )
        parser.add_argument(
            "--timeout-ms",
            type=float,
            default=300.0,
            metavar="MS",
            help="longest wait for a reply, in ms (default: 300)",
        )
        parser.add_argument(
            "--pause-ms",
            type=float,
            default=20.0,
            metavar="MS",
            help="pause before each request, in ms (default: 20)",
        )
        parser.add_argument(
            "--seconds",
            type=float,
            metavar="S",
            help="time for which the registers are read again and again, in s (default: five times in all)",
        )
        parser.add_argument(
            "--baud",
            type=int,
            default=19_200,
            metavar="BIT/S",
            help="baud rate of a serial port (default: 19200)",
        )
        parser.add_argument(
            "--parity",
            choices=("none", "even", "odd"),
            default="even",
            help="parity of a serial port (default: even)",
        )
        parser.add_argument(
            "--all-orders", action="store_true", help="print the values in all byte and word orders"
        )

    def sniff(
        self, arguments: argparse.Namespace, stop: threading.Event, tell: Callable[[str], None]
    ) -> Sniffed:
        """See `drivers.sniffing.Sniffer.sniff`."""
        from daqsvc.acquisition.clock import SystemClock  # noqa: PLC0415 - only for who scans
        from drivers.modbus.replies import LineLostError  # noqa: PLC0415
        from drivers.modbus.scan import Scan, units_in_words  # noqa: PLC0415
        from drivers.modbus.scan_report import ScanReport  # noqa: PLC0415

        units = units_of(arguments.units)
        registers = registers_of(arguments.registers or REGISTERS)
        begin, end = registers.begin, registers.end
        note = registers.note(arguments.function)
        if end > LAST_REGISTER:
            raise SniffError(note, usage=True)
        if not 0 <= arguments.pause_ms <= 10_000:
            raise SniffError(f"--pause-ms {arguments.pause_ms:g}: give 0 to 10000 ms", usage=True)
        if arguments.seconds is not None and not 0 < arguments.seconds <= LONGEST_SECONDS:
            wrong = f"--seconds {arguments.seconds:g}: give a time above 0, up to {LONGEST_SECONDS:g} s"
            raise SniffError(wrong, usage=True)
        bus = _bus(arguments)
        functions = _FUNCTIONS[arguments.function]
        scan = Scan(bus, SystemClock(), stop, arguments.pause_ms / 1000, tell)
        asked = units_in_words(units)
        tell(
            f"asking {bus.where} for {asked}, at most {math.ceil(scan.longest_s(len(units)))} s; then for "
            f"registers {begin} to {end} of each one that answers; Ctrl-C ends it early"
        )
        try:
            scanning = scan.run(
                units,
                functions,
                begin,
                end,
                until_found=arguments.function == AUTO,
                read_on=arguments.registers is None,
                seconds=arguments.seconds,
            )
            asyncio.run(scanning)
        except LineLostError as error:
            message = f"{error}".replace("correct host and tcp_port", "correct TARGET").replace(
                "correct host", "correct TARGET"
            )
            raise SniffError(
                f"{bus.where}: {message.replace('correct serial_port', 'correct TARGET')}"
            ) from error
        return ScanReport(bus, scan, functions, note, all_orders=arguments.all_orders).sniffed()


class RegisterRange(NamedTuple):
    """Registers to look at.

    Attributes:
        begin: the first one.
        end: the last one; beyond the address space only if they look like the numbers of a manual.
        manuals_first: the number that manuals give the first register, if they look so.
    """

    begin: int
    end: int
    manuals_first: int | None

    @property
    def there(self) -> str:
        """The same on the line, if they are numbers of a manual."""
        first = self.manuals_first or 0
        return f"{self.begin - first}-{self.end - first}"

    @property
    def table(self) -> str:
        """Which registers they are, if they are numbers of a manual; else empty."""
        if self.manuals_first is None:
            return ""
        return "input" if self.manuals_first in _INPUT else "holding"

    @property
    def reason(self) -> str:
        """Why they are most likely numbers of a manual; empty if they are not."""
        if self.manuals_first is None:
            return ""
        return (
            f"registers {self.begin} to {self.end} look like numbers of a manual, where {self.table} "
            f"registers begin at {self.manuals_first}; on the line they are {self.there}"
        )

    def note(self, function: str) -> str:
        """The same with its remedy, where one of the functions, or all, are to be asked for."""
        if not self.reason:
            return ""
        other = self.table == "input" and function != "both"
        return f"{self.reason}. Remedy: write --registers {self.there}{' --function 4' if other else ''}"


def registers_of(text: str) -> RegisterRange:
    """The registers of ``A-B``, or ``A``.

    Raises:
        SniffError: they are no registers.
    """
    from drivers.modbus.checks import manuals_first  # noqa: PLC0415 - brings the settings

    begin, end = _range(text, "--registers", _LONG_MANUALS_FIRST[-1] + LAST_REGISTER)
    first = manuals_first(begin) or next(
        (one for one in _LONG_MANUALS_FIRST if one <= begin <= one + LAST_REGISTER), None
    )
    if first is None and end > LAST_REGISTER:
        raise SniffError(_no_range("--registers", text, LAST_REGISTER), usage=True)
    return RegisterRange(begin, end, first)


def units_of(text: str) -> list[int]:
    """Addresses of ``A-B``, ``A``, or several of them with commas between.

    Raises:
        SniffError: they are none.
    """
    units: set[int] = set()
    for part in text.split(","):
        first, last = _range(part.strip(), "--units", 255)
        units.update(range(first, last + 1))
    return sorted(units)


def _range(text: str, option: str, most: int) -> tuple[int, int]:
    """First and last of ``A-B``, or ``A`` twice.

    Raises:
        SniffError: it is none.
    """
    if (match := _FIRST_LAST.fullmatch(text.strip())) is not None:
        low, high = (
            int(one, 16 if one[:2] in {"0x", "0X"} else 10) for one in (match[1], match[2] or match[1])
        )
        if low <= high <= most:
            return low, high
    raise SniffError(_no_range(option, text, LAST_REGISTER if option == "--registers" else most), usage=True)


def _no_range(option: str, text: str, most: int) -> str:
    return f"{option} {text!r}: write FIRST-LAST from 0 to {most}, e.g. 1-10"


def _bus(arguments: argparse.Namespace) -> ModbusBus:
    """The table that a machine file would have for the line.

    Raises:
        SniffError: an argument is no value that it could have.
    """
    from pydantic import ValidationError  # noqa: PLC0415 - only for who scans

    from daqsvc.settings.error_messages import ErrorFormatter  # noqa: PLC0415
    from drivers.modbus.settings import ModbusRtuBus, ModbusTcpBus  # noqa: PLC0415
    from drivers.tty import is_pseudo_terminal  # noqa: PLC0415

    common = {"driver": "modbus", "timeout_ms": arguments.timeout_ms}
    target: str = arguments.target
    if Path(target).is_char_device():
        target = f"{Path(target).absolute()}"
    model: type[ModbusTcpBus | ModbusRtuBus] = ModbusTcpBus
    if target.startswith("/"):
        model = ModbusRtuBus
        parity = "none" if is_pseudo_terminal(target) else arguments.parity
        serial = {"serial_port": target, "baud": arguments.baud, "parity": parity}
        table = {**common, "transport": "rtu", **serial}
    else:
        host, colon, port = target.rpartition(":")
        if not colon or "]" in port or (host.count(":") and not host.startswith("[")):
            host, port = target, f"{TCP_PORT}"
        if not port.isdecimal():
            raise SniffError(f"TARGET {target!r}: write HOST, HOST:PORT or /dev/ttyS0", usage=True)
        table = {**common, "transport": "tcp", "host": host.strip("[]"), "tcp_port": int(port)}
    try:
        return model.model_validate(table)
    except ValidationError as error:
        wrong = error.errors()[0]
        key = f"{wrong['loc'][-1]}"
        option = {"timeout_ms": "--timeout-ms", "baud": "--baud"}.get(key)
        subject = f"TARGET {target!r}" if option is None else f"{option} {wrong['input']:g}"
        what = {"tcp_port": "the TCP port "}.get(key, "")
        message, _, _ = ErrorFormatter(model, table).say(wrong, wrong["loc"])
        raise SniffError(f"{subject}: {what}{message}", usage=True) from error
