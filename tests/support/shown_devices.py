"""The devices of docs/sniff.md, as a separate process: a serial one and a Modbus gateway.

``python -m support.shown_devices LINK PORT``, LINK the serial port that it makes, PORT a free one of this
computer. It reports when both are there, and goes on until it is killed.
"""

from __future__ import annotations

import asyncio
import struct
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from sim_hw.nodes.modbus_node import ModbusTcpServer
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.serial_node import PseudoTerminal

READY = "ready"
LINE_S = 0.01
ABSENT = 10
"""Exception of a gateway behind which no unit answers."""


class Pump(ModbusUnit):
    """Registers as docs/sniff.md shows them; 1, 40, 41 and 43 move from one reading of them to the next."""

    def __init__(self) -> None:
        super().__init__()
        self.put("holding", 0, struct.pack(">4H", 7, 1481, 300, 0))
        self.put("holding", 40, struct.pack(">2f", 23.45, 1.91))
        self._read_times: Counter[int] = Counter()

    def answer(self, pdu: bytes) -> bytes:
        """See `ModbusUnit.answer`."""
        reply = super().answer(pdu)
        if not reply[0] & 0x80:
            _, first, count = struct.unpack(">BHH", pdu)
            self._read_times.update(range(first, first + count))
            self.put("holding", 1, struct.pack(">H", 1481 + self._read_times[1] % 3))
            self.put("holding", 40, struct.pack(">f", 23.45 + 0.1 * (self._read_times[41] % 5)))
            self.put("holding", 42, struct.pack(">f", 1.91 + 1e-4 * (self._read_times[43] % 5)))
        return reply


class Absent(ModbusUnit):
    """An address behind the gateway where no unit is."""

    def answer(self, pdu: bytes) -> bytes:
        """See `ModbusUnit.answer`."""
        return bytes([pdu[0] | 0x80, ABSENT])


async def talk(cable: PseudoTerminal) -> None:
    """Send lines of an accelerometer for as long as this goes on."""
    random, number = np.random.default_rng(1), 19
    while True:
        x, y = random.normal([0.0, -1.0], [0.15, 0.1])
        number += cable.send(f"$ACC,{number},{x:.3f},{y:.3f},41.3\r\n".encode())
        await asyncio.sleep(LINE_S)


async def main(link: Path, port: int) -> None:
    """Be both devices."""
    server = ModbusTcpServer({3: Pump(), 4: Absent()}, port=port)
    await server.start()
    with PseudoTerminal(link) as cable:
        print(READY, flush=True)  # noqa: T201 - whoever has started it waits for this
        await talk(cable)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]), int(sys.argv[2])))
