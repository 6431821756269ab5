"""A python-can interface whose failures are up to the test: ``interface = "faulty"``."""

from __future__ import annotations

import queue
from typing import Any

import can


class FaultyBus(can.BusABC):
    """Receives what a test puts into `FaultyBus.inbox`; an exception in there is raised by `recv`."""

    inbox: queue.Queue[can.Message | BaseException]
    open_errors: list[BaseException]
    opened = 0
    closed = 0
    dead = False

    @classmethod
    def renew(cls) -> None:
        cls.inbox = queue.Queue()
        cls.open_errors = []
        cls.opened = cls.closed = 0
        cls.dead = False

    def __init__(self, channel: Any = None, **options: Any) -> None:
        if self.open_errors:
            raise self.open_errors.pop(0)
        super().__init__(channel=channel)
        type(self).opened += 1
        self.channel_info = "faulty"
        self._can_protocol = can.CanProtocol.CAN_FD

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            item = self.inbox.get(timeout=timeout) if timeout else self.inbox.get_nowait()
        except queue.Empty:
            return None, False
        if isinstance(item, BaseException):
            raise item
        return item, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    @property  # type: ignore[misc]  # nobody sets it
    def state(self) -> can.BusState:
        return can.BusState.ERROR if self.dead else can.BusState.ACTIVE

    def shutdown(self) -> None:
        type(self).closed += 1
        super().shutdown()


can.interfaces.BACKENDS["faulty"] = ("support.fake_can", "FaultyBus")
# python-can froze the names when it was imported.
can.util.VALID_INTERFACES = frozenset(can.interfaces.BACKENDS)  # type: ignore[attr-defined]
