"""``daqsvc sniff modbus``: which units answer, which registers they have, and what those may mean."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from drivers.sniffing import Sniffed, Sniffer, SniffError, SniffTable, quoted, sensor_lines

if TYPE_CHECKING:
    import argparse
    import threading
    from collections.abc import Callable, Iterator, Sequence

    from drivers.modbus.readings import Reading
    from drivers.modbus.scan import FoundTable, Scan
    from drivers.modbus.settings import ModbusBus

TCP_PORT = 502
UNITS = "1-247"
REGISTERS = "0-200"
_AUTO = "auto"
_FUNCTIONS = {_AUTO: (3, 4), "3": (3,), "4": (4,), "both": (3, 4)}
_TABLES = {3: "holding", 4: "input"}
_MOST_CHANNELS = 64
_LAST_REGISTER = 65_535


class ModbusSniffer(Sniffer):
    """See `drivers.sniffing.Sniffer`."""

    help = "scan a Modbus server or line: units that answer, their registers, what those may mean"
    description = (
        "Read the registers of a Modbus TCP server, or of the units on a serial line, twice. Print "
        "which registers exist, which of them change, and which numbers they may be. It sends one "
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
            help=f"addresses of units to try, e.g. 1-10 (default: {UNITS})",
        )
        parser.add_argument(
            "--registers",
            default=REGISTERS,
            metavar="A-B",
            help=f"addresses of registers to read, e.g. 0-99 (default: {REGISTERS})",
        )
        parser.add_argument(
            "--function",
            choices=tuple(_FUNCTIONS),
            default=_AUTO,
            help="function code: 3 reads holding registers, 4 input registers (default: auto: 3, and 4 for "
            "a unit without holding registers)",
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
        from drivers.modbus.scan import Scan, most_requests  # noqa: PLC0415

        first_unit, last_unit = _range(arguments.units, "--units", 255)
        begin, end = _range(arguments.registers, "--registers", _LAST_REGISTER)
        if not 0 <= arguments.pause_ms <= 10_000:
            raise SniffError(f"--pause-ms {arguments.pause_ms:g}: give 0 to 10000 ms", usage=True)
        bus = _bus(arguments)
        functions = _FUNCTIONS[arguments.function]
        units = range(first_unit, last_unit + 1)
        probes, most = most_requests(len(units), len(functions), end + 1 - begin)
        wait_s = probes * (arguments.pause_ms + arguments.timeout_ms) / 1000
        tell(
            f"asking {bus.where}: {probes} request{'s' * (probes != 1)} to find units, at most "
            f"{math.ceil(wait_s)} s; then at most {most} for each unit that answers; Ctrl-C ends it early"
        )
        scan = Scan(bus, SystemClock(), stop, arguments.pause_ms / 1000)
        try:
            until_found = arguments.function == _AUTO
            asyncio.run(scan.run(units, functions, begin, end, until_found=until_found))
        except LineLostError as error:
            said = f"{error}".replace("correct host and tcp_port", "correct TARGET").replace(
                "correct host", "correct TARGET"
            )
            raise SniffError(
                f"{bus.where}: {said.replace('correct serial_port', 'correct TARGET')}"
            ) from error
        return _Report(bus, scan, arguments.all_orders, (first_unit, last_unit), functions).sniffed()


def _range(text: str, option: str, most: int) -> tuple[int, int]:
    """First and last of ``A-B``, or ``A`` twice.

    Raises:
        SniffError: it is none.
    """
    low, _, high = text.partition("-")
    if low.isdecimal() and (high or low).isdecimal() and int(low) <= int(high or low) <= most:
        return int(low), int(high or low)
    raise SniffError(f"{option} {text!r}: write FIRST-LAST from 0 to {most}, e.g. 1-10", usage=True)


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
        said, _, _ = ErrorFormatter(model, table).say(wrong, wrong["loc"])
        raise SniffError(f"{subject}: {what}{said}", usage=True) from error


class _Report(NamedTuple):
    """What was found, in words, in figures and as a machine file."""

    bus: ModbusBus
    scan: Scan
    all_orders: bool
    units: tuple[int, int]
    functions: tuple[int, ...]

    def sniffed(self) -> Sniffed:
        """All of it."""
        return Sniffed(list(self._parts()), self._figures(), self._fragment(), self._problem())

    def _problem(self) -> str:
        scan, where = self.scan, self.bus.where
        if scan.lost:
            return f"{where} was lost: {scan.lost}"
        if not scan.units and scan.stop.is_set():
            return f"{where}: it was ended before a unit answered"
        if not scan.units:
            asked = f"units {self.units[0]} to {self.units[1]}"
            gateway = (
                f"; a gateway reports that no unit answers at {len(scan.gateway)} of them"
                if scan.gateway
                else ""
            )
            return (
                f"{where}: none of {asked} answers{gateway}. Remedy: check that the device is powered, that "
                "baud rate and parity are its own, that A and B are not swapped, and its unit address; a "
                "slow one needs a longer --timeout-ms"
            )
        if not any(table.first for table in scan.tables) and not scan.stop.is_set():
            asked = " and ".join(map(str, self.functions))
            other = ""
            if len(self.functions) == 1:
                other = ", and for its tables (--function both)"
            return (
                f"{where}: no register could be read by function {asked}. Remedy: see the device's manual "
                f"for its addresses (--registers){other}"
            )
        return ""

    def _parts(self) -> Iterator[str | SniffTable]:
        scan = self.scan
        found = ", ".join(map(str, scan.units)) or "none"
        yield f"{self.bus.where}: {scan.requests} requests; units that answer: {found}"
        if scan.alike:
            yield "It answers in the name of every unit, so it is one device; only the first one was read."
        if scan.gateway:
            many = f"{len(scan.gateway)} address{'es' * (len(scan.gateway) != 1)}"
            yield f"A gateway reports that no unit answers behind it at {many}."
        for table in scan.tables:
            yield from self._table(table)

    def _table(self, table: FoundTable) -> Iterator[str | SniffTable]:
        from drivers.modbus.replies import EXCEPTIONS  # noqa: PLC0415 - only for who scans

        name = f"Unit {table.unit}, {_TABLES[table.function]} registers (function {table.function})"
        runs = ", ".join(f"{low}" if low == high else f"{low}-{high}" for low, high in table.runs)
        yield f"{name}: {f'{len(table.first)} at {runs}' if runs else 'none'}"
        for address, code in table.refused.items():
            yield f"{name}: refused from {address} on: exception {code}, {EXCEPTIONS.get(code, 'unknown')}"
        if table.silent:
            yield f"{name}: no reply to requests from {', '.join(map(str, table.silent))} on"
        if table.first:
            yield SniffTable(
                ("address", "hex", "uint16", "int16", "moves", "may be"),
                [self._row(table, address) for address in sorted(table.first)],
            )

    def _row(self, table: FoundTable, address: int) -> Sequence[str]:
        from drivers.modbus.readings import chosen, readings  # noqa: PLC0415 - only for who scans

        raw = table.first[address]
        shown = [one for one in chosen(table.first, table.second) if one.address == address]
        if self.all_orders:
            shown = readings(table.first, table.second, address)
        return (
            f"{address}",
            f"{raw:04x}",
            f"{raw}",
            f"{_signed(raw)}",
            "yes" if address in table.moved else "",
            "; ".join(_words(one, mark=self.all_orders) for one in shown),
        )

    def _figures(self) -> dict[str, Any]:
        from drivers.modbus.readings import readings  # noqa: PLC0415 - only for who scans

        scan = self.scan
        return {
            "bus": "modbus",
            "where": self.bus.where,
            "requests": scan.requests,
            "units": scan.units,
            "units_gateway": scan.gateway,
            "units_alike": scan.alike,
            "tables": [
                {
                    "unit": table.unit,
                    "function": table.function,
                    "runs": [list(run) for run in table.runs],
                    "refused": [[address, code] for address, code in table.refused.items()],
                    "silent": table.silent,
                    "moved": sorted(table.moved),
                    "channels": [one._asdict() for one in _channels(table)],
                    "registers": [
                        {
                            "address": address,
                            "uint16": value,
                            "int16": _signed(value),
                            "later": table.second.get(address),
                            "readings": [
                                {
                                    "type": one.type,
                                    "order": one.order,
                                    "value": one.value if math.isfinite(one.value) else None,
                                    "plausible": one.plausible,
                                }
                                for one in readings(table.first, table.second, address)
                            ],
                        }
                        for address, value in sorted(table.first.items())
                    ],
                }
                for table in scan.tables
            ],
        }

    def _fragment(self) -> str:
        from drivers.modbus.settings import ModbusTcpBus  # noqa: PLC0415 - only for who scans

        tables = [table for table in self.scan.tables if table.first]
        if not tables:
            return ""
        bus = self.bus
        lines = ["[buses.modbus]", 'driver = "modbus"']
        if isinstance(bus, ModbusTcpBus):
            lines += ['transport = "tcp"', f"host = {quoted(bus.host)}", f"tcp_port = {bus.tcp_port}"]
        else:
            lines += ['transport = "rtu"', f"serial_port = {quoted(bus.serial_port)}", f"baud = {bus.baud:_}"]
            lines.append(f"parity = {quoted(bus.parity)}")
        lines.append(f"timeout_ms = {bus.timeout_ms}")
        sensors: set[str] = set()
        for table in tables:
            lines += ["", *self._stream(table, sensors)]
        return "\n".join(lines)

    def _stream(self, table: FoundTable, sensors: set[str]) -> Iterator[str]:
        channels = list(_channels(table))
        name = f"unit-{table.unit}" + ("" if table.function == 3 else "-input")
        yield f"[streams.{name}]"
        yield 'bus = "modbus"'
        yield "rate_hz = 1.0"
        yield ""
        yield f"[streams.{name}.layout]    # types are a guess: see the device's register map"
        yield 'way = "registers"'
        yield f"unit = {table.unit}"
        if table.function == 4:
            yield 'table = "input"'
        yield "max_gap = 0    # registers between them may not be there"
        yield "channels = ["
        yield from (f"  {{ {one.keys} }}," for one in channels)
        yield "]"
        yield from sensor_lines(name, dict.fromkeys((one.name for one in channels), "1"), sensors)


class _Channel(NamedTuple):
    """A number that is worth reading."""

    name: str
    address: int
    type: str
    order: str

    @property
    def keys(self) -> str:
        """As in a machine file."""
        order = "" if self.order == "ABCD" else f", order = {quoted(self.order)}"
        return f"name = {quoted(self.name)}, address = {self.address}, type = {quoted(self.type)}{order}"


def _channels(table: FoundTable) -> Iterator[_Channel]:
    """What to read: numbers that are likely, else registers that move, else those that are not 0."""
    from drivers.modbus.readings import chosen  # noqa: PLC0415 - only for who scans

    wide: dict[int, Reading] = {one.address: one for one in chosen(table.first, table.second)}
    covered = {place for one in wide.values() for place in range(one.address, one.address + one.registers)}
    alone = [address for address in sorted(table.first) if address not in covered]
    moving = [address for address in alone if address in table.moved]
    singles = set(
        moving or ([] if wide else [address for address in alone if table.first[address]] or alone[:1])
    )
    for address in sorted({*wide, *singles})[:_MOST_CHANNELS]:
        one = wide.get(address)
        kind, order = ("uint16", "ABCD") if one is None else (one.type, one.order)
        yield _Channel(f"r{address}", address, kind, order)


def _words(one: Reading, *, mark: bool) -> str:
    star = "*" if mark and one.plausible else ""
    return f"{star}{one.type} {one.order} {one.value:.6g}"


def _signed(raw: int) -> int:
    return raw - 65_536 if raw >= 32_768 else raw
