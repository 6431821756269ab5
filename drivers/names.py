"""What buses, streams and sensors are called: the same in the tables of ``daqsvc sniff`` and ``daqsvc new``.

Whoever has the file of one adds the tables of the other: what is one thing must have one name there. All are
spelled as the device spells them.
"""

from __future__ import annotations

import re
from pathlib import Path

BUS, STREAM = "main", "device"
"""Of a simulated machine, or where nothing on the bus has a name."""
MODBUS, CAN, SERIAL = "modbus", "can0", "serial0"
"""The only bus of Modbus, and those whose port or interface has no usable name."""
LINES, FRAMES = "lines", "frames"
"""Streams of a serial port whose lines begin with no word, or that carries binary frames."""
LONGEST_NAME = 64
"""Characters of a name in a machine file."""
_LONGEST_TABLE = 40
SENSOR_PREFIX = {"proximity": "probe-", "accelerometer": "accel-", "velocity": "velocity-"}
"""What the name of a sensor begins with, by its type."""
_REGISTER = re.compile(r"r\d+")
"""Channels that are called like their registers, as those found on a Modbus line: each table may have one."""
_LASTING = Path("/dev/serial")
"""Below it are the long names of the serial ports, each a link to the short one."""


def table_name(text: str, otherwise: str) -> str:
    """A name for a table of a machine file, which needs no quotes; ``otherwise`` if nothing is left of it."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", text).strip("-")[:_LONGEST_TABLE] or otherwise


def unused(name: str, taken: set[str]) -> str:
    """A name that nothing has yet; it is taken then."""
    free, number = name[:LONGEST_NAME], 2
    while free in taken:
        free, number = f"{name[: LONGEST_NAME - 5]}-{number}", number + 1
    taken.add(free)
    return free


def bus_name(port: str, otherwise: str) -> str:
    """Of the bus at a serial port, a CAN interface or the path of one between programs."""
    path = Path(port)
    if path.is_relative_to(_LASTING) and path.exists():
        path = path.resolve()
    return table_name(path.name, otherwise)


def message_stream(message: str) -> str:
    """Of the frames of a message in a DBC file."""
    return table_name(message, STREAM)


def lines_stream(prefix: str | None) -> str:
    """Of the lines of text that begin with a word; empty or None if there is none."""
    return table_name(prefix or "", LINES)


def unit_stream(unit: int, table: str) -> str:
    """Of what is read of a Modbus unit, from its ``holding`` or its ``input`` registers."""
    return f"unit-{unit}{'-input' * (table == 'input')}"


def is_register(channel: str) -> bool:
    """Whether a channel is called like its register, so that its name states no quantity."""
    return _REGISTER.fullmatch(channel) is not None


def sensor_name(channel: str, kind: str, stream: str, *, by_stream: bool = False) -> str:
    """Of the sensor on a channel.

    Args:
        channel: its name.
        kind: type of the sensor.
        stream: name of its stream.
        by_stream: whether others have channels of the same names: its own then begins with the stream.
    """
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "-", channel).strip("-") or "sensor"
    before = f"{stream}-" if by_stream or is_register(channel) else ""
    return f"{SENSOR_PREFIX.get(kind, '')}{before}{plain}"[:LONGEST_NAME]
