"""What a scan of a Modbus line has found: in words, in figures, and as tables of a machine file."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, NamedTuple

from drivers.modbus.proposed import TIMEOUT_MS, unit_of_register
from drivers.modbus.readings import chosen, is_signed, readings, undecided
from drivers.modbus.replies import EXCEPTIONS
from drivers.modbus.scan import ILLEGAL_FUNCTION, LAST_REGISTER, TABLES, units_in_words
from drivers.modbus.settings import ModbusTcpBus
from drivers.names import MODBUS, unit_stream
from drivers.sniffing import Sniffed, SniffTable, quoted, sensor_lines

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from drivers.modbus.readings import Reading
    from drivers.modbus.scan import FoundTable, Scan
    from drivers.modbus.scan_json import ModbusFigures, TableFigures
    from drivers.modbus.settings import ModbusBus

_FEW = 12
"""Number of values up to which all are proposed, whether they moved or not."""
_MOST_CHANNELS = 64
NO_VALUE = frozenset({0x7FFF, 0x8000, 0xFFFF})
"""What many devices write into a register when they have no value."""


class ScanReport:
    """What was found.

    Args:
        bus: the line.
        scan: of it, at its end.
        functions: that were asked for.
        note: what is to be reported of the registers that were asked for; may be empty.
        all_orders: whether registers are shown in all orders.
    """

    def __init__(
        self, bus: ModbusBus, scan: Scan, functions: Sequence[int], note: str, *, all_orders: bool
    ) -> None:
        self._bus = bus
        self._scan = scan
        self._functions = functions
        self._all_orders = all_orders
        self._note = note
        self._tables = [(table, chosen(table.rounds)) for table in scan.tables]
        self._undecided = [undecided(table.rounds, numbers) for table, numbers in self._tables]

    def sniffed(self) -> Sniffed:
        """All of it."""
        return Sniffed(list(self._parts()), self._figures(), self._fragment(), self._problem())

    def _problem(self) -> str:
        scan, where = self._scan, self._bus.where
        if scan.lost:
            return f"{where} was lost: {scan.lost}"
        if not scan.units and scan.stop.is_set():
            return f"{where}: it was ended before a unit answered ({self._asked})"
        if not scan.units:
            gateway = (
                f"; a gateway reports that no unit answers at {len(scan.gateway)} of them"
                if scan.gateway
                else ""
            )
            return f"{where}: no unit answers ({self._asked}){gateway}. Remedy: {self._to_check()}"
        if not any(table.first for table in scan.tables) and not scan.stop.is_set():
            functions = " and ".join(map(str, self._functions))
            last = max((table.last for table in scan.tables if table.last is not None), default=None)
            begin = scan.tables[0].begin
            asked = f"register {begin}" if begin == last else f"registers {begin} to {last}"
            other = ", and for its tables (--function both)" if len(self._functions) == 1 else ""
            others = (
                ", and for its unit address (--units N), as others may have some"
                if scan.alike or scan.left_out
                else ""
            )
            whose = f" of {units_in_words(scan.units)}" if others else ""
            were = "was" if begin == last else "were"
            more = self._note or (
                f"{asked}{whose} {were} asked. Remedy: see the device's manual for its addresses "
                f"(--registers){other}{others}"
            )
            return f"{where}: no register could be read by function {functions}; {more}"
        return ""

    @property
    def _asked(self) -> str:
        """Which units were asked."""
        first, last = self._scan.first_unit, self._scan.asked
        if last is None:
            return "none was asked"
        units = [unit for unit in self._scan.to_ask if first <= unit <= last]
        return f"{units_in_words(units)} {'was' if first == last else 'were'} asked"

    @property
    def _late(self) -> int:
        """How many replies came after the time-out, which only TCP shows."""
        return self._scan.counters.replies_wrong_transaction

    def _to_check(self) -> str:
        """What there is to see to if nobody answers."""
        bus = self._bus
        slow = f"a slow one needs a longer --timeout-ms than {bus.timeout_ms:g}"
        if self._late:
            return late_words(self._late, bus.timeout_ms)
        if not isinstance(bus, ModbusTcpBus):
            return (
                "check that the device is powered, that baud rate and parity are its own, that A and B are "
                f"not swapped, and its unit address; {slow}"
            )
        if self._scan.gateway:
            return (
                "check that the device has one of these addresses (--units) and is powered, and compare the "
                f"gateway's baud rate, parity and wiring (A, B) with the device's; {slow}"
            )
        return (
            f"check that {bus.host} is the device's address and {bus.tcp_port} its Modbus port, that its "
            f"unit address is among those (--units), and that no firewall drops the requests; {slow}"
        )

    def _parts(self) -> Iterator[str | SniffTable]:
        scan = self._scan
        answering = ", ".join(map(str, scan.units)) or "none"
        early = "" if scan.searched else ", then it was ended"
        asked = f"{self._asked}{early}"
        yield f"{self._bus.where}: {scan.requests} requests; units that answer: {answering} ({asked})"
        if scan.alike:
            yield (
                "It answers in the name of every unit, and alike, so it is taken for one device: only unit "
                f"{scan.units[0]} was read; --units N reads unit N."
            )
        if scan.exception is not None:
            yield (
                f"Units {_runs(scan.left_out)} all answer with {_exception(scan.exception)}, as for units "
                "that are not there: they were not read; --units N reads unit N."
            )
        if scan.units and self._late:
            yield f"{late_words(self._late, self._bus.timeout_ms)} to find what is missing."
        if scan.gateway:
            many = f"{len(scan.gateway)} address{'es' * (len(scan.gateway) != 1)}"
            yield f"A gateway reports that no unit answers behind it at {many}."
        if self._note and any(table.first for table in scan.tables):
            yield f"{self._note[0].upper()}{self._note[1:]}."
        if self._all_orders:
            yield "* marks the readings that look like quantities; without --all-orders only these are shown."
        refusing = self._refusing()
        for (table, numbers), doubted in zip(self._tables, self._undecided, strict=True):
            code = _only_refusal(table)
            units = [] if code is None else refusing[table.function, code]
            if code is None or len(units) == 1:
                yield from self._table(table, numbers, doubted)
            elif units[0] == table.unit:
                whose = units_in_words(units)
                name = f"{whose[0].upper()}{whose[1:]}, {TABLES[table.function]} registers"
                yield f"{name} (function {table.function}): none; each answers with {_exception(code)}"

    def _refusing(self) -> dict[tuple[int, int], list[int]]:
        """Units that answer with nothing but one exception, by function and exception."""
        units: dict[tuple[int, int], list[int]] = {}
        for table, _ in self._tables:
            if (code := _only_refusal(table)) is not None:
                units.setdefault((table.function, code), []).append(table.unit)
        return units

    def _table(
        self, table: FoundTable, numbers: Sequence[Reading], doubted: Sequence[Reading]
    ) -> Iterator[str | SniffTable]:
        name = f"{table.name[0].upper()}{table.name[1:]}"
        if table.last is None:
            yield f"{name}: not read: {'the line was lost' if self._scan.lost else 'ended'} before"
            return
        none = "none" if table.complete else "none so far"
        runs = f"{len(table.first)} at {_runs(table.first)}" if table.first else none
        lines = [f"{name}: {runs}", *self._range(table)]
        for address, code in table.refused.items():
            lines.append(f"refused from {address} on: {_exception(code)}")
        if table.silent:
            lines.append(f"no reply to requests from {', '.join(map(str, table.silent))} on")
        if table.max_count is not None:
            lines.append(f"Registers in a request: {table.max_count} at most (max_count).")
        yield "\n".join(lines)
        if table.first:
            yield SniffTable(
                ("address", "hex", "uint16", "int16", "moves", "may be"),
                [self._row(table, numbers, doubted, address) for address in sorted(table.first)],
            )
        if halves := _halves(table, numbers, doubted):
            yield textwrap.fill(f"{undecided_words(halves)}.", 100)

    def _range(self, table: FoundTable) -> Iterator[str]:
        """Which registers were asked for, and how to look further."""
        if ILLEGAL_FUNCTION in table.refused.values():
            return
        last = table.begin if table.last is None else table.last
        asked = f"Registers {table.begin} to {last} were asked"
        if table.begin == last:
            asked = f"Register {last} was asked"
        further = min(2 * last - table.begin if last > table.begin else last + 100, LAST_REGISTER)
        if not table.complete:
            why = "the line was lost" if self._scan.lost else "it was ended"
            yield f"{asked}, then {why}."
        elif further <= last or self._note:
            yield f"{asked}."
        elif last in table.first:
            yield f"{asked}, and {last} exists: --registers {table.begin}-{further} looks further."
        else:
            yield f"{asked}; --registers {table.begin}-{further} looks further."
        if self._may_be_in_inputs(table):
            yield "None of them moves: --function both reads the input registers of the unit, too."

    def _may_be_in_inputs(self, table: FoundTable) -> bool:
        """Whether the measured values may be in the other table: many devices have only settings in this."""
        asked = {one.function for one, _ in self._tables if one.unit == table.unit}
        return bool(table.complete and table.first and not table.moved and asked == {3})

    def _row(
        self, table: FoundTable, numbers: Sequence[Reading], doubted: Sequence[Reading], address: int
    ) -> Sequence[str]:
        raw = table.first[address]
        shown = [one for one in numbers if one.address == address]
        if self._all_orders:
            shown = readings(table.rounds, address)
        else:
            shown += [one for one in doubted if one.address == address]
        return (
            f"{address}",
            f"{raw:04x}",
            f"{raw}",
            f"{_signed(raw)}",
            "yes" if address in table.moved else "",
            "; ".join(f"{_words(one, mark=self._all_orders)}{'?' * (one in doubted)}" for one in shown)
            or self._no_value(table, numbers, address),
        )

    def _no_value(self, table: FoundTable, numbers: Sequence[Reading], address: int) -> str:
        """A hint where a register shows nothing but what devices write when they have no value."""
        is_mark = address not in _covered(numbers) and _mark(table, address) is not None
        return "no value?" if is_mark else ""

    def _figures(self) -> ModbusFigures:
        scan = self._scan
        return {
            "bus": "modbus",
            "where": self._bus.where,
            "requests": scan.requests,
            "units": scan.units,
            "units_asked": [] if scan.asked is None else [scan.first_unit, scan.asked],
            "units_gateway": scan.gateway,
            "units_alike": scan.alike,
            "units_left_out": scan.left_out,
            "replies_late": self._late,
            "tables": [
                _table_figures(table, numbers, doubted)
                for (table, numbers), doubted in zip(self._tables, self._undecided, strict=True)
            ],
        }

    def _fragment(self) -> str:
        tables = [
            (table, numbers, doubted)
            for (table, numbers), doubted in zip(self._tables, self._undecided, strict=True)
            if table.first
        ]
        if not tables:
            return ""
        bus = self._bus
        lines = [f"[buses.{MODBUS}]", 'driver = "modbus"']
        if isinstance(bus, ModbusTcpBus):
            lines += ['transport = "tcp"', f"host = {quoted(bus.host)}", f"tcp_port = {bus.tcp_port}"]
        else:
            lines += ['transport = "rtu"', f"serial_port = {quoted(bus.serial_port)}", f"baud = {bus.baud:_}"]
            lines.append(f"parity = {quoted(bus.parity)}")
        lines.append(f"timeout_ms = {max(bus.timeout_ms, TIMEOUT_MS)}")
        sensors: set[str] = set()
        for table, numbers, doubted in tables:
            lines += ["", *_stream(table, numbers, doubted, sensors)]
        return "\n".join(lines)


def _exception(code: int) -> str:
    return f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}"


def _only_refusal(table: FoundTable) -> int | None:
    """The exception that the unit answers with, if it answers with nothing else."""
    codes = set(table.refused.values())
    is_all = table.complete and not table.first and not table.silent
    return codes.pop() if is_all and len(codes) == 1 else None


def late_words(replies: int, timeout_ms: float) -> str:
    """That so many replies came after the time-out, and which one to give."""
    came = f"{replies} repl{'y' if replies == 1 else 'ies'} came later than --timeout-ms {timeout_ms:g}"
    return f"{came}: write --timeout-ms {max(1000, round(3 * timeout_ms))}"


def undecided_words(addresses: Iterable[int]) -> str:
    """That two registers each may be one number, and how to find out."""
    pairs = [f"{address} and {address + 1}" for address in addresses]
    each = ": each pair" if len(pairs) > 1 else ""
    return (
        f"Registers {', '.join(pairs)}{each} may be one 32-bit number, e.g. a float32, and not two of 16 "
        "bits; values that stand still do not show it. See the device's register map, or listen again while "
        "the values change"
    )


def _halves(table: FoundTable, numbers: Sequence[Reading], doubted: Sequence[Reading]) -> list[int]:
    """First registers of those that may be one number and are proposed as two."""
    proposed = {one.address for one in _channels(table, numbers)}
    return [one.address for one in doubted if proposed & set(one.places)]


def _table_figures(table: FoundTable, numbers: Sequence[Reading], doubted: Sequence[Reading]) -> TableFigures:
    last = table.again[-1] if table.again else {}
    return {
        "unit": table.unit,
        "function": table.function,
        "asked": [] if table.last is None else [table.begin, table.last],
        "complete": table.complete,
        "runs": [list(run) for run in table.runs],
        "refused": [[address, code] for address, code in table.refused.items()],
        "silent": table.silent,
        "max_count": table.max_count,
        "moved": sorted(table.moved),
        "channels": [
            {
                "name": one.name,
                "address": one.address,
                "type": one.type,
                "order": one.order,
                "no_value": one.no_value,
            }
            for one in _channels(table, numbers)
        ],
        "undecided": [
            {"address": one.address, "type": one.type, "order": one.order, "value": one.value}
            for one in doubted
        ],
        "registers": [
            {
                "address": address,
                "uint16": value,
                "int16": _signed(value),
                "later": last.get(address),
                "readings": [
                    {
                        "type": one.type,
                        "order": one.order,
                        "value": one.value if math.isfinite(one.value) else None,
                        "plausible": one in numbers or one.plausible,
                    }
                    for one in readings(table.rounds, address)
                ],
            }
            for address, value in sorted(table.first.items())
        ],
    }


def _stream(
    table: FoundTable, numbers: Sequence[Reading], doubted: Sequence[Reading], sensors: set[str]
) -> Iterator[str]:
    channels = list(_channels(table, numbers))
    name = unit_stream(table.unit, TABLES[table.function])
    yield f"[streams.{name}]"
    yield f"bus = {quoted(MODBUS)}"
    yield "rate_hz = 1.0"
    yield ""
    guessed = "types and no_value" if any(one.no_value is not None for one in channels) else "types"
    yield f"[streams.{name}.layout]    # {guessed} are a guess: see the device's register map"
    yield 'way = "registers"'
    yield f"unit = {table.unit}"
    if table.function == 4:
        yield 'table = "input"'
    yield "max_gap = 0    # registers between them may not be there"
    if table.max_count is not None:
        yield f"max_count = {table.max_count}    # it refuses requests of more registers"
    if halves := _halves(table, numbers, doubted):
        words = textwrap.wrap(f"{undecided_words(halves)}.", 90)
        yield from (f"# {line}" for line in words)
    yield "channels = ["
    yield from (f"  {{ {one.keys} }}," for one in channels)
    yield "]"
    last = channels[-1].address
    taken = _covered(numbers) | {one.address for one in channels}
    left_out = [address for address in table.first if address not in taken and address <= last]
    beyond = [address for address in table.first if address not in taken and address > last]
    if len(channels) < _MOST_CHANNELS:
        left_out, beyond = [*left_out, *beyond], []
    if left_out:
        yield f"# left out, as they did not change: {_runs(left_out)}"
    if beyond:
        yield f"# left out, as there are so many: {_runs(beyond)}"
    units = {one.name: unit_of_register(one.type) for one in channels}
    yield from sensor_lines(name, units, sensors)


class _Channel(NamedTuple):
    """A number that is worth reading."""

    name: str
    address: int
    type: str
    order: str
    no_value: int | None = None

    @property
    def keys(self) -> str:
        """As in a machine file."""
        order = "" if self.order == "ABCD" else f", order = {quoted(self.order)}"
        mark = "" if self.no_value is None else f", no_value = 0x{self.no_value:04X}"
        return (
            f"name = {quoted(self.name)}, address = {self.address}, type = {quoted(self.type)}{order}{mark}"
        )


def _channels(table: FoundTable, numbers: Sequence[Reading]) -> Iterator[_Channel]:
    """What to read: all numbers if they are few, else likely ones and those that move, else not 0."""
    wide = {one.address: one for one in numbers}
    covered = _covered(numbers)
    alone = [address for address in sorted(table.first) if address not in covered]
    singles = alone
    if len(wide) + len(alone) > _FEW:
        moving = [address for address in alone if address in table.moved]
        not_0 = [address for address in alone if table.first[address]] or alone[:1]
        singles = moving or ([] if wide else not_0)
    for address in sorted({*wide, *singles})[:_MOST_CHANNELS]:
        if address in wide:
            yield _Channel(f"r{address}", address, wide[address].type, wide[address].order)
        else:
            signed = is_signed([these[address] for these in table.rounds if address in these])
            kind = "int16" if signed else "uint16"
            yield _Channel(f"r{address}", address, kind, "ABCD", _mark(table, address))


def _mark(table: FoundTable, address: int) -> int | None:
    """The raw value by which a register most likely states that it has none; None if it does not."""
    seen = {these[address] for these in table.rounds if address in these}
    return seen.pop() if len(seen) == 1 and seen <= NO_VALUE else None


def _covered(numbers: Iterable[Reading]) -> set[int]:
    """Registers of numbers of 32 and 64 bits."""
    return {place for one in numbers for place in one.places}


def _runs(addresses: Iterable[int]) -> str:
    """Registers as a person writes them: 0-3, 7."""
    runs: list[list[int]] = []
    for address in sorted(addresses):
        if runs and address == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], address]
        else:
            runs.append([address])
    return ", ".join("-".join(map(str, run)) for run in runs)


def _words(one: Reading, *, mark: bool) -> str:
    star = "*" if mark and one.plausible else ""
    # A whole number is compared with the display of the device, digit by digit.
    value = f"{one.value:.6g}" if one.type.startswith("float") else f"{one.value:.0f}"
    return f"{star}{one.type} {one.order} {value}"


def _signed(raw: int) -> int:
    return raw - 65_536 if raw >= 32_768 else raw
