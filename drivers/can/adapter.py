"""Any interface that python-can knows, as a source of batches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import can
import numpy as np

from drivers.can.batches import (
    BIT_RATE_SWITCH,
    ERROR,
    ERROR_PASSIVE_SENDER,
    EXTENDED,
    EXTENDED_ID,
    FD,
    LONGEST,
    REMOTE,
    BusOffError,
    CanBatch,
)
from drivers.can.errors import ALL_CLASSES, BUS_OFF

if TYPE_CHECKING:
    import threading
    from collections.abc import Iterator, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.can.settings import CanBus

LINUX_ERRORS = frozenset({"unixbus"})
"""Interfaces whose error frames mean what Linux's mean; on others only bus-off is alike."""

BATCH_FRAMES = 2048
GATHER_S = 0.002
"""A frame is taken to come when it is read: the longer it waits, the later."""


class CanAdapter:
    """One open bus of python-can, which gives a frame per call.

    Args:
        bus: the bus; it is shut down with this.
        clock: clock of the arrival times; each frame is stamped when it is taken.
        error_classes: see `drivers.can.batches.CanSource`.
    """

    recovers = False

    def __init__(self, bus: can.BusABC, clock: Clock, error_classes: int = BUS_OFF) -> None:
        self.error_classes = error_classes
        self._bus = bus
        self._clock = clock
        self._failure: Exception | None = None

    def read(self, timeout_s: float) -> CanBatch:
        """See `drivers.can.batches.CanSource.read`."""
        if self._failure is not None:
            raise self._failure
        messages: list[can.Message] = []
        arrival_ns: list[int] = []
        drained_ns: int | None = None
        asked_ns = self._clock.monotonic_ns()
        while len(messages) < BATCH_FRAMES:
            try:
                message = self._bus.recv(0 if messages else timeout_s)
            except Exception as error:
                if not messages:
                    raise
                self._failure = error  # for the next read, after what came before it
                break
            if message is None:
                # Asked before the bus was: whatever was sent until then has been seen by now.
                drained_ns = asked_ns
                break
            asked_ns = self._clock.monotonic_ns()
            messages.append(message)
            arrival_ns.append(asked_ns)
        if self._failure is None and self._bus.state == can.BusState.ERROR:
            self._failure = BusOffError()
            if not messages:
                raise self._failure
        return batch_of(messages, arrival_ns, drained_ns)

    def gather(self, stopping: threading.Event) -> None:
        """See `drivers.can.batches.CanSource.gather`."""
        stopping.wait(GATHER_S)

    def close(self) -> None:
        """See `drivers.can.batches.CanSource.close`."""
        # With its traceback it would hold the bus until the next garbage collection.
        self._failure = None
        self._bus.shutdown()


def open_adapter(bus: CanBus, clock: Clock) -> CanAdapter:
    """Open an interface of python-can.

    Args:
        bus: its table in the machine file.
        clock: clock of the arrival times.

    Raises:
        Exception: adapters raise what they like.
    """
    chosen = dict(bus.options)
    if bus.bitrate is not None:
        chosen["bitrate"] = bus.bitrate
    if bus.data_bitrate is not None:
        chosen["data_bitrate"] = bus.data_bitrate
    if bus.interface == "virtual":
        chosen["protocol"] = can.CanProtocol.CAN_FD if bus.fd else can.CanProtocol.CAN_20
    else:
        chosen["fd"] = bus.fd
    return CanAdapter(
        can.Bus(channel=bus.channel, interface=bus.interface, **chosen),
        clock,
        ALL_CLASSES if bus.interface in LINUX_ERRORS else BUS_OFF,
    )


def batch_of(
    messages: Sequence[can.Message], arrival_ns: Sequence[int], drained_ns: int | None = None
) -> CanBatch:
    """Messages of python-can as arrays.

    Args:
        messages: in their order of arrival.
        arrival_ns: when each arrived.
        drained_ns: see `CanBatch`.
    """
    n = len(messages)
    ids = np.fromiter((_id(m) for m in messages), np.uint32, n)
    lengths = np.fromiter((m.dlc if m.is_remote_frame else len(m.data) for m in messages), np.int64, n)
    fd_flags = np.fromiter((_fd_flags(m) for m in messages), np.uint8, n)
    raw = b"".join(m.data.ljust(LONGEST, b"\0") for m in messages)
    data = np.frombuffer(raw, np.uint8).reshape(n, LONGEST)
    return CanBatch(
        ids, lengths, data, np.array(arrival_ns, np.int64), drained_ns=drained_ns, fd_flags=fd_flags
    )


def messages_of(batch: CanBatch, t_us: Sequence[int]) -> Iterator[can.Message]:
    """Arrays as messages of python-can.

    Args:
        batch: the frames.
        t_us: the time stamp of each, in microseconds.
    """
    fd_flags = [0] * len(batch.ids) if batch.fd_flags is None else batch.fd_flags.tolist()
    payloads, width = batch.data.tobytes(), batch.data.shape[1]
    for k, (frame_id, length, fd, t) in enumerate(
        zip(batch.ids.tolist(), batch.lengths.tolist(), fd_flags, t_us, strict=True)
    ):
        remote = bool(frame_id & REMOTE)
        yield can.Message(
            timestamp=t / 1e6,
            arbitration_id=frame_id & EXTENDED_ID,
            is_extended_id=bool(frame_id & EXTENDED),
            is_remote_frame=remote,
            is_error_frame=bool(frame_id & ERROR),
            is_fd=bool(fd),
            bitrate_switch=bool(fd & BIT_RATE_SWITCH),
            error_state_indicator=bool(fd & ERROR_PASSIVE_SENDER),
            dlc=length,
            data=None if remote else payloads[k * width : k * width + length],
        )


def _id(message: can.Message) -> int:
    flags = EXTENDED if message.is_extended_id else 0
    if message.is_error_frame:
        flags |= ERROR
    if message.is_remote_frame:
        flags |= REMOTE
    return message.arbitration_id | flags


def _fd_flags(message: can.Message) -> int:
    if not message.is_fd:
        return 0
    flags = FD
    if message.bitrate_switch:
        flags |= BIT_RATE_SWITCH
    if message.error_state_indicator:
        flags |= ERROR_PASSIVE_SENDER
    return flags
