"""What ``daqsvc sniff modbus --json`` prints."""

from __future__ import annotations

from typing import TypedDict


class RegisterReading(TypedDict):
    """One way to read a register and those behind it.

    Attributes:
        type: type of the number.
        order: order of bytes and words.
        value: the number; null if it is none.
        plausible: whether it looks like a quantity.
    """

    type: str
    order: str
    value: float | None
    plausible: bool


class RegisterFigures(TypedDict):
    """One register.

    Attributes:
        address: its address, from 0.
        uint16: its value without a sign.
        int16: its value with a sign.
        later: its value when it was read for the last time; null if it was read once.
        readings: ways to read it with those behind it.
    """

    address: int
    uint16: int
    int16: int
    later: int | None
    readings: list[RegisterReading]


class ProposedChannel(TypedDict):
    """A channel that is proposed for the machine file.

    Attributes:
        name: name of the channel.
        address: its first register.
        type: type of the number.
        order: order of bytes and words.
        no_value: raw value by which the device most likely states that it has none; null without one.
    """

    name: str
    address: int
    type: str
    order: str
    no_value: int | None


class UndecidedPair(TypedDict):
    """Two registers that are proposed as two numbers, and may be one of 32 bits.

    Attributes:
        address: the first of them.
        type: type of the number that they may be.
        order: its order of bytes and words.
        value: the number.
    """

    address: int
    type: str
    order: str
    value: float


class TableFigures(TypedDict):
    """What one function reads of a unit.

    Attributes:
        unit: address of the unit.
        function: 3 for holding registers, 4 for input registers.
        asked: first and last register that was asked for; empty if there was no time for any.
        complete: whether all were asked for.
        runs: first and last register of each run that there is.
        refused: first register of a request and the exception that answered, but illegal address.
        silent: first registers of requests without a reply.
        max_count: registers that the unit answers at once; null if it has refused no request for its length.
        moved: registers whose values changed.
        channels: what is proposed for the machine file.
        undecided: two registers each of these that may be one number.
        registers: each register with its value.
    """

    unit: int
    function: int
    asked: list[int]
    complete: bool
    runs: list[list[int]]
    refused: list[list[int]]
    silent: list[int]
    max_count: int | None
    moved: list[int]
    channels: list[ProposedChannel]
    undecided: list[UndecidedPair]
    registers: list[RegisterFigures]


class ModbusFigures(TypedDict):
    """What is on a Modbus line.

    Attributes:
        bus: kind of the bus.
        where: address of the host, or serial port.
        requests: how many requests were made.
        units: units that answered.
        units_asked: first and last unit that was asked; empty if none was.
        units_gateway: units of which a gateway reported that there is none.
        units_alike: whether every address answered alike, so that only the first is taken for a unit.
        units_left_out: addresses that were not read, as they gave the exception that most addresses gave.
        replies_late: how many replies came after the time-out; 0 on a serial line, where none shows it.
        tables: what was read.
    """

    bus: str
    where: str
    requests: int
    units: list[int]
    units_asked: list[int]
    units_gateway: list[int]
    units_alike: bool
    units_left_out: list[int]
    replies_late: int
    tables: list[TableFigures]
