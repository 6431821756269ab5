"""What ``daqsvc new --listen`` found of the units of a Modbus line, for the questions and for the file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.bus_questions import Heard, guessed_sensors
from drivers.modbus.manual_addresses import manual_note, table_meant
from drivers.modbus.sniff import AUTO, registers_of
from drivers.modbus.values_heard import SHOWN, in_register, values_heard
from drivers.questions import Answers, sensor_key

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence


TABLES = {3: "holding", 4: "input"}
"""By function code."""


def register_count(raw_type: str) -> int:
    """Registers of a number."""
    return int(raw_type[-2:]) // 16


def in_words(figures: Mapping[str, Any], timeout_ms: float) -> Iterator[str]:
    """What was found, in a few lines: which units answer, and the registers that are worth reading."""
    from drivers.modbus.scan_report import NO_VALUE, late_words  # noqa: PLC0415 - brings the settings

    yield from _units_in_words(figures)
    if figures["replies_late"]:
        yield f"{late_words(figures['replies_late'], timeout_ms)} to find what is missing"
    for table in figures["tables"]:
        if not table["registers"]:
            continue
        name = f"unit {table['unit']} has {TABLES[table['function']]} registers {_runs_in_words(table)}"
        were = "was" if len(set(table["asked"])) == 1 else "were"
        only_0 = ": all of them read 0" if _is_0(table) else ":"
        yield f"{name} ({_asked(table)} {were} asked; --registers looks further){only_0}"
        if table["max_count"] is not None:
            yield f"  registers in a request: {table['max_count']} at most"
        by_address = {one["address"]: one for one in table["registers"]}
        wide = {one["address"]: one for one in table["channels"] if not one["type"].endswith("int16")}
        unsigned = {one["address"] for one in table["channels"] if one["type"] == "uint16"}
        behind = {
            address + number
            for address, one in wide.items()
            for number in range(1, register_count(one["type"]))
        }
        undecided = {one["address"]: one for one in table["undecided"]}
        shown = [address for address in by_address if address not in behind]
        if len(shown) > SHOWN:
            shown = [address for address in shown if address in wide or address in table["moved"]]
        for address in shown[:SHOWN]:
            width = register_count(wide[address]["type"]) if address in wide else 1
            moved = any(address + number in table["moved"] for number in range(width))
            moves = ", moves" if moved else ""
            value, meant = f"{by_address[address]['uint16' if address in unsigned else 'int16']}", ""
            if address in wide:
                one = wide[address]
                same = [
                    reading
                    for reading in by_address[address]["readings"]
                    if (reading["type"], reading["order"]) == (one["type"], one["order"])
                ]
                value, meant = f"{same[0]['value']:.6g}", f" as {one['type']} {one['order']}"
            if address in undecided:
                one = undecided[address]
                meant = f", or with {address + 1} {one['value']:.6g} as {one['type']} {one['order']}"
            is_mark = address not in wide and not moved and by_address[address]["uint16"] in NO_VALUE
            yield f"  {address}: {value}{meant}{moves}{', no value?' if is_mark else ''}"
        if len(shown) > SHOWN:
            yield f"  ... and {len(shown) - SHOWN} more: daqsvc sniff modbus shows them"


class HeardUnits(Heard):
    """Units that have registers.

    Attributes:
        figures: those of `drivers.modbus.sniff.ModbusSniffer`.
    """

    def __init__(
        self,
        figures: Mapping[str, Any],
        lines: Sequence[str],
        registers: str,
        next_address: Callable[[Answers, str], int],
    ) -> None:
        super().__init__(lines, _only_0(figures, registers))
        self.figures, self._next_address = figures, next_address

    def proposals(self, answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`."""
        from drivers.modbus.readings import is_signed  # noqa: PLC0415 - only for who listens
        from drivers.modbus.scan_report import NO_VALUE  # noqa: PLC0415

        proposed, tables = self._place(answers)
        if not tables or answers.get("way") != "values":
            return proposed
        if tables[0]["max_count"] is not None:
            proposed["max-count"] = f"{tables[0]['max_count']}"
        scanned_channels = {one["address"]: one for one in tables[0]["channels"]}
        values = {one["address"]: one["int16"] for one in tables[0]["registers"]}
        marks = {
            one["address"]: one["uint16"]
            for one in tables[0]["registers"]
            if one["uint16"] in NO_VALUE and one["address"] not in tables[0]["moved"]
        }
        proposed["channels"] = ", ".join(one["name"] for one in scanned_channels.values())
        for channel in answers.get("channels", ()):
            if sensor_key(channel, "register-type") not in answers:
                address = answers.get(sensor_key(channel, "address"))
                if address is None:
                    address = self._heard_address(answers, channel, scanned_channels, values)
                    proposed[sensor_key(channel, "address")] = f"{address}"
                kind = scanned_channels.get(address, {"type": "uint16", "order": "ABCD"})
                negative = address not in scanned_channels and is_signed([values.get(address, 0) & 0xFFFF])
                if kind["type"] != "uint16" or negative:
                    proposed[sensor_key(channel, "register-type")] = "int16" if negative else kind["type"]
                proposed[sensor_key(channel, "order")] = kind["order"]
                break
            address = answers[sensor_key(channel, "address")]
            if address in scanned_channels:
                proposed[sensor_key(channel, "order")] = scanned_channels[address]["order"]
            if address in marks and register_count(answers[sensor_key(channel, "register-type")]) == 1:
                proposed[sensor_key(channel, "no-value")] = f"0x{marks[address]:04X}"
        return proposed

    def beside(self, answers: Answers) -> dict[str, str]:
        """See `Heard.beside`: what the register reads that a channel gets, whatever its name suggests."""
        proposed, tables = self.proposals(answers), self._place(answers)[1]
        channel = next(
            (one for one in answers.get("channels", ()) if sensor_key(one, "address") in proposed), ""
        )
        if not channel or not tables:
            return {}
        address = int(proposed[sensor_key(channel, "address")])
        kind = proposed.get(sensor_key(channel, "register-type"), "uint16")
        order = proposed[sensor_key(channel, "order")]
        return {sensor_key(channel, "address"): in_register(tables[0], address, kind, order)}

    def _heard_address(
        self, answers: Answers, channel: str, channels: Mapping[int, Any], values: Mapping[int, int]
    ) -> int:
        """The register that a channel is named after, the one behind the last, or the next that was found."""
        by_name = next((address for address, one in channels.items() if one["name"] == channel), None)
        following = self._next_address(answers, channel)
        if by_name is not None or following in values:
            return following if by_name is None else by_name
        return next((address for address in sorted(values) if address > following), following)

    def _place(self, answers: Answers) -> tuple[dict[str, str], list[Mapping[str, Any]]]:
        """The unit and the table to propose, and what was found of those that are answered."""
        tables = [one for one in self.figures["tables"] if one["registers"]]
        # Where all is 0, or stands still, nothing shows that the values are there.
        likely = min(tables, key=lambda one: (_is_0(one), not one["moved"]))
        proposed = {"unit": f"{likely['unit']}"}
        tables = [one for one in tables if one["unit"] == answers.get("unit", int(proposed["unit"]))]
        meant = table_meant(answers, "registers")
        tables.sort(key=lambda one: (TABLES[one["function"]] != meant, _is_0(one), *_stillness(one)))
        if tables and not (len(tables) > 1 and all(map(_is_0, tables)) and meant is None):
            proposed["table"] = TABLES[tables[0]["function"]]
        return proposed, [one for one in tables if TABLES[one["function"]] == answers.get("table")]

    def unheard(self, answers: Answers) -> str:
        """See `Heard.unheard`: the unit that was answered has sent nothing."""
        figures = self.figures
        if figures["units_alike"] or answers.get("unit", figures["units"][0]) in figures["units"]:
            return ""
        unit, others = answers["unit"], ", ".join(map(str, figures["units"]))
        first, last = figures["units_asked"]
        if not first <= unit <= last:
            return (
                f"Unit {unit} was not asked. Remedy: write --units {unit}, too; those that answer: {others}"
            )
        outcome = "has refused, like most units" if unit in figures["units_left_out"] else "has not answered"
        return f"Unit {unit} {outcome}. Remedy: correct --unit; those that answer: {others}"

    def notes(self, answers: Answers, assumed: Collection[str], taken: Collection[str]) -> Iterable[str]:
        """See `Heard.notes`: what was read of the channels, and what the values of registers do not show."""
        del assumed
        if answers["way"] != "values":
            return
        table = _table_read(self.figures, answers)
        if table is not None:
            yield from values_heard(table, answers)
        guessed = [name for name in answers["channels"] if sensor_key(name, "register-type") in taken]
        yield from _guessed_addresses(answers, taken)
        if guessed:
            yield _guessed_words(answers, guessed, taken)
        yield from guessed_sensors(answers, answers["channels"], taken)
        if table is None:
            return
        yield from _may_be_halves(table, answers, guessed)
        if _is_0(table):
            yield "All registers that were read are 0: nothing shows that the values are there."

    def not_read(self, answers: Answers) -> Iterable[str]:
        """See `Heard.not_read`: the other table of the unit, if it has values, and the other units."""
        figures = self.figures
        if answers["way"] == "values":
            yield from self._not_read_of_unit(answers)
        units = [unit for unit in figures["units"] if unit != answers["unit"]]
        named = "; ".join(f"unit {unit} ({_has(figures, unit)})" for unit in units[:SHOWN])
        more = f"; and {len(units) - SHOWN} more" if len(units) > SHOWN else ""
        if units and not figures["units_alike"]:
            with_registers = [unit for unit in units if _has(figures, unit) != _NO_REGISTERS]
            which = "each" if with_registers == units else "each that has registers"
            proposes = f" daqsvc sniff modbus --function both proposes a stream for {which}."
            yield f"Not read: {named}{more}.{proposes if with_registers else ''}"

    def _not_read_of_unit(self, answers: Answers) -> Iterator[str]:
        """What else the unit has: its other table, and registers that stand still."""
        unit, read = answers["unit"], answers["table"]
        mine = [one for one in self.figures["tables"] if one["unit"] == unit and one["registers"]]
        still = (
            " None of both moved: see the device's register map for which are measured."
            if not any(one["moved"] for one in mine)
            else ""
        )
        for table in mine:
            other = TABLES[table["function"]]
            if other != read and not _is_0(table):
                yield f"Unit {unit} has {other} registers, too; this file reads {read} registers.{still}"
            if other == read and (left := _left_out(table, answers)):
                moved = len(left & {*table["moved"]}) or "none"
                runs = _runs_in_words({"runs": _runs(left)})
                yield f"Not read of unit {unit}: {read} registers {runs}; of these {moved} moved."


class HeardNoRegisters(Heard):
    """Units that answer, although none of the registers that were asked for is there."""

    def __init__(self, figures: Mapping[str, Any], registers: str) -> None:
        note = "" if registers == AUTO else manual_note(registers_of(registers))
        remedy = "Remedy: write the addresses of its manual, counted from 0, as --registers, e.g. 4000-4100"
        unsure = figures["units_alike"] or figures["units_left_out"]
        others = "; or name other units with --units" if unsure else ""
        missed = note or f"No register that was asked for is there. {remedy}{others}"
        super().__init__([*_units_in_words(figures), *_tables_in_words(figures)], missed)
        self._unit: int = figures["units"][0]
        self._tables = {
            table["unit"]: TABLES[table["function"]]
            for table in reversed(figures["tables"])
            if table["asked"] and _has_function(table)
        }

    def proposals(self, answers: Answers) -> Mapping[str, str]:
        """See `Heard.proposals`: the unit, and the table that it has."""
        table = self._tables.get(answers.get("unit", self._unit))
        return {"unit": f"{self._unit}"} | ({} if table is None else {"table": table})


def _has_function(table: Mapping[str, Any]) -> bool:
    """Whether the unit does not refuse to read tables of this kind at all."""
    from drivers.modbus.scan import ILLEGAL_FUNCTION  # noqa: PLC0415 - only for who listens

    return all(code != ILLEGAL_FUNCTION for _, code in table["refused"])


def _tables_in_words(figures: Mapping[str, Any]) -> Iterator[str]:
    """Which tables units have of which no register was found."""
    for table in figures["tables"]:
        name, unit = TABLES[table["function"]], table["unit"]
        if not _has_function(table):
            yield f"unit {unit} has no {name} registers: it refuses function {table['function']}"
        elif table["asked"]:
            none = "no" if len(set(table["asked"])) == 1 else "none of"
            yield f"unit {unit} answers for {name} registers, but has {none} {_asked(table)}"


def _may_be_halves(table: Mapping[str, Any], answers: Answers, guessed: Sequence[str]) -> Iterator[str]:
    """That channels of one register may be the halves of a number of two."""
    from drivers.modbus.scan_report import undecided_words  # noqa: PLC0415 - brings the settings

    single = {
        answers[sensor_key(name, "address")]
        for name in guessed
        if register_count(answers[sensor_key(name, "register-type")]) == 1
    }
    if halves := [one for one in table["undecided"] if single & {one["address"], one["address"] + 1}]:
        one = halves[0]
        keys = f'address = {one["address"]}, type = "{one["type"]}", order = "{one["order"]}"'
        yield (
            f"{undecided_words(each['address'] for each in halves)}. If so, write one channel in place of "
            f"two{', e.g.' if len(halves) > 1 else ':'} {keys}."
        )


def _stillness(table: Mapping[str, Any]) -> tuple[bool, int]:
    """Less where registers move; among tables that stand still, less where nothing but measured values are.

    Holding registers may be settings, and input registers are none.
    """
    return not table["moved"], 0 if table["moved"] else -table["function"]


def _left_out(table: Mapping[str, Any], answers: Answers) -> set[int]:
    """Registers that are neither proposed nor read by a channel."""
    channels = [(one["address"], one["type"]) for one in table["channels"]]
    channels += [
        (answers[sensor_key(name, "address")], answers[sensor_key(name, "register-type")])
        for name in answers["channels"]
    ]
    read = {address + number for address, kind in channels for number in range(register_count(kind))}
    return {one["address"] for one in table["registers"]} - read


def _runs(addresses: Collection[int]) -> list[tuple[int, int]]:
    """First and last of those in a row."""
    runs: list[tuple[int, int]] = []
    for address in sorted(addresses):
        begin = runs.pop()[0] if runs and address == runs[-1][1] + 1 else address
        runs.append((begin, address))
    return runs


def _is_0(table: Mapping[str, Any]) -> bool:
    """Whether all registers of a table read 0 all the time."""
    return not table["moved"] and not any(one["uint16"] for one in table["registers"])


def _is_only_0(figures: Mapping[str, Any]) -> bool:
    """Whether all registers that were read are 0."""
    return all(map(_is_0, figures["tables"]))


def _only_0(figures: Mapping[str, Any], registers: str) -> str:
    """See `Heard.missed`: all registers are 0, and nobody has stated which of them are the values."""
    if not _is_only_0(figures) or (registers != AUTO and not registers_of(registers).reason):
        return ""
    manual = "give --registers (and --table, holding or input) from its manual"
    meant = (
        "" if registers == AUTO else manual_note(registers_of(registers)).replace("Remedy: write", "Write")
    )
    return (
        "All registers that were read are 0, and nothing shows where the values are. Remedy: switch the "
        f"machine and its sensors on, or {manual}{'. ' * bool(meant)}{meant[:1].upper()}{meant[1:]}"
    )


def _guessed_addresses(answers: Answers, taken: Collection[str]) -> list[str]:
    """That channels which are not named after their registers have them by the order of their names."""
    addresses = {name: answers[sensor_key(name, "address")] for name in answers["channels"]}
    named = [
        f"{name} ({address})"
        for name, address in addresses.items()
        if sensor_key(name, "address") in taken and name != f"r{address}"
    ]
    if not named:
        return []
    more = [f"and {len(named) - SHOWN} more"] if len(named) > SHOWN else []
    which = ", ".join([*named[:SHOWN], *more])
    return [
        f"Addresses that are a guess by the order of names: {which}. Compare with the device's register map."
    ]


def _guessed_words(answers: Answers, guessed: Sequence[str], taken: Collection[str]) -> str:
    """What of some channels nobody has stated."""
    about = ["type"]
    if any(register_count(answers[sensor_key(name, "register-type")]) > 1 for name in guessed):
        about.append("byte order")
    if any(sensor_key(name, "scale") in taken for name in guessed):
        about.append("scale")
    what = " and ".join([", ".join(about[:-1]), about[-1]] if len(about) > 1 else about)
    whose = ", ".join(guessed) if len(guessed) < len(answers["channels"]) else "the registers"
    are = "are" if len(about) > 1 else "is"
    return (
        f"{what[0].upper()}{what[1:]} of {whose} {are} a guess by the values that were read: compare with "
        "the device's register map."
    )


_NO_REGISTERS = "no registers were found"


def _has(figures: Mapping[str, Any], unit: int) -> str:
    """Which registers were found of a unit."""
    tables = [one for one in figures["tables"] if one["unit"] == unit and one["registers"]]
    return (
        ", ".join(
            f"{TABLES[one['function']]} registers {_runs_in_words(one)}{', all 0' if _is_0(one) else ''}"
            for one in tables
        )
        or _NO_REGISTERS
    )


def _runs_in_words(table: Mapping[str, Any]) -> str:
    """The registers that a table has."""
    runs = [f"{low}" if low == high else f"{low} to {high}" for low, high in table["runs"]]
    return ", ".join([*runs[:SHOWN], *([f"and {len(runs) - SHOWN} more"] if len(runs) > SHOWN else [])])


def _table_read(figures: Mapping[str, Any], answers: Answers) -> Mapping[str, Any] | None:
    """The table that the file reads, as it was found; None if it was not."""
    return next(
        (
            one
            for one in figures["tables"]
            if one["unit"] == answers["unit"] and TABLES[one["function"]] == answers["table"]
        ),
        None,
    )


def _asked(table: Mapping[str, Any]) -> str:
    """The first and the last register that was asked for, or the only one."""
    return " to ".join(map(str, dict.fromkeys(table["asked"])))


def _units_in_words(figures: Mapping[str, Any]) -> Iterator[str]:
    """Which units answer, of those that were asked, and which of these were not read."""
    first, last = figures["units_asked"]
    asked = f"unit {first} was" if first == last else f"units {first} to {last} were"
    yield f"units that answer: {', '.join(map(str, figures['units']))} ({asked} asked)"
    if figures["units_alike"]:
        yield f"all answer alike, so only unit {figures['units'][0]} was read: --units N reads unit N"
    elif left_out := figures["units_left_out"]:
        yield (
            f"the others from {left_out[0]} to {left_out[-1]} all refuse with one exception, as if they were "
            "not there: --units N reads unit N"
        )
