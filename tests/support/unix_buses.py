"""The virtual CAN bus over a Unix socket, for the tests of it: a hub, frames by number, waiting."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import can
from support.waiting import PATIENCE_S

from sim_hw.bus_socket_hub import Hub

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextlib.contextmanager
def running(path: str, **options: Any) -> Iterator[Hub]:
    hub = Hub(path, **options)
    hub.start()
    try:
        yield hub
    finally:
        hub.stop()


def frame(number: int, **fields: Any) -> can.Message:
    return can.Message(arbitration_id=number, is_extended_id=False, data=number.to_bytes(4, "big"), **fields)


def numbers(bus: can.BusABC, wait_s: float = PATIENCE_S, until: int | None = None) -> list[int]:
    """Numbers of the frames that are there, -1 for an error frame; ends with ``until`` if that is given."""
    found: list[int] = []
    while (message := bus.recv(wait_s)) is not None:
        found.append(-1 if message.is_error_frame else message.arbitration_id)
        if found[-1] == until:
            break
    return found
