"""The command line on CAN interfaces that are none: sockets that it is given carry the bytes of SocketCAN.

``python -m support.wired_service '{"can0": 5}' run FILE``: the interface ``can0`` is descriptor 5. What such
a process takes is measured, so nothing is imported here that the service does not import as well.
"""

from __future__ import annotations

import json
import socket
import sys
from importlib import import_module
from typing import TYPE_CHECKING

from daqsvc import kernel_cache
from daqsvc.cli import main
from daqsvc.kernel_compiler import compile_apart

if TYPE_CHECKING:
    from daqsvc.acquisition.clock import Clock
    from drivers.can.settings import CanBus
    from drivers.can.socketcan import SocketCan

LAG_EVERY_S = 0.01
LAG_SECONDS = 10.0
"""The delay of the event loop is measured more often than usual, so that its 99th percentile is sure."""


def run(wires: dict[str, int], arguments: list[str]) -> int:
    """Run a verb.

    Args:
        wires: by interface, the descriptor of a socket.
        arguments: of the command line.
    """

    # As `daqsvc run` does before it imports kernels: else this process compiles those that are not kept, and
    # keeps what that takes.
    kernel_cache.prepare()
    compile_apart()
    service, driver, socketcan = map(
        import_module, ("daqsvc.service", "drivers.can.driver", "drivers.can.socketcan")
    )

    def open_wire(bus: CanBus, _matches: object, clock: Clock, *, recorded: bool = False) -> SocketCan:
        del recorded
        made: SocketCan = socketcan.SocketCan(socket.socket(fileno=wires[bus.channel]).dup(), clock)
        return made

    vars(driver)["open_socketcan"] = open_wire
    vars(service)["LAG_EVERY_S"] = LAG_EVERY_S
    vars(service)["LAG_REMEMBERED"] = round(LAG_SECONDS / LAG_EVERY_S)
    return main(arguments)


if __name__ == "__main__":
    sys.exit(run(json.loads(sys.argv[1]), sys.argv[2:]))
