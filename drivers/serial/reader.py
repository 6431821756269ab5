"""The two threads of an open serial port.

One takes bytes from the port's file descriptor and gathers them into batches. The other finds and decodes the
frames of each batch, mostly without the interpreter's lock, and hands them to the event loop; meanwhile the
first one reads on. When the event loop cannot keep up they wait.
"""

from __future__ import annotations

import array
import errno
import fcntl
import logging
import os
import queue
import random
import select
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from daqsvc.errors.buses import DRIVER_FAILED
from daqsvc.errors.code import coded
from daqsvc.errors.service import STOPPED_HARD
from drivers.reconnect import HandOver
from drivers.serial.pauses import Pauses

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    import serial
    from numpy.typing import NDArray

    from daqsvc.acquisition.clock import Clock
    from drivers.frames import DecodedBatch
    from drivers.serial.framing import Framing

logger = logging.getLogger(__name__)

POLL_MS = 50
GATHER_NS = 100_000_000
"""How long bytes are gathered into one batch: a turn of every part then serves them all."""

READ_BYTES = 65_536
BATCH_BYTES = 524_288
BATCHES_UNDER_WAY = 16
SHUTDOWN_S = 0.5
LINE_ERRORS_EVERY_NS = 1_000_000_000
TIOCGICOUNT = 0x545D
"""Linux: counts of interrupts and errors of a UART (asm-generic/ioctls.h, struct serial_icounter_struct)."""

GONE = {errno.EIO, errno.ENXIO, errno.ENODEV, errno.EBADF}


class Receiver(Protocol):
    """Receives what the reader finds; called on the event loop, once in a turn of it."""

    def accept(self, batch: DecodedBatch) -> None:
        """Take in a batch."""
        ...

    def tick(self, drained_ns: int) -> None:
        """Nothing more is under way that was sent before ``drained_ns``, host monotonic."""
        ...

    def note(self, counter: str, count: int = 1) -> None:
        """Add to one of the bus's counters."""
        ...


class LineErrors(NamedTuple):
    """What a UART has counted; see `SerialCounters`."""

    framing_errors: int
    overruns: int
    parity_errors: int
    breaks: int


class _HungUpError(Exception):
    """The port is gone."""


class SerialReader(threading.Thread):
    """Reads one open port until stopped or the port fails; `ended` then holds the reason.

    It brings the thread that cuts what it has read. All calls to the event loop go through that thread, so
    they arrive in order.

    Args:
        name: what a person calls the port.
        device: the open port, in non-blocking mode.
        framing: cuts what is read into frames; used by the cutting thread alone.
        receiver: who is given the frames.
        clock: stamps arrivals.
        loop: where the receiver lives.
        longest_pause_s: how long the port may be left alone; see `drivers.serial.pauses`.
        turn: called on this thread each time it comes round.

    Attributes:
        ended: what becomes the reason why the reading has ended.
        cutter: the thread that finds and decodes the frames.
    """

    def __init__(
        self,
        name: str,
        device: serial.Serial,
        framing: Framing,
        receiver: Receiver,
        clock: Clock,
        loop: asyncio.AbstractEventLoop,
        longest_pause_s: float = 0.0,
        turn: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(name=f"reader of {name}", daemon=True)
        self.ended: asyncio.Future[str] = loop.create_future()
        self._device = device
        self._fd = device.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._framing = framing
        self._pauses = Pauses(framing, longest_pause_s)
        self._rng = random.Random()  # noqa: S311
        self._receiver = receiver
        self._clock = clock
        self._turn = turn
        self._hand = HandOver(loop)
        self._stopping = threading.Event()
        self._under_way = threading.BoundedSemaphore(BATCHES_UNDER_WAY)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self.cutter = threading.Thread(target=self._cut_on, name=f"cutter of {name}", daemon=True)
        self._line_errors = line_errors(self._fd)
        self._line_errors_due_ns = 0

    def start(self) -> None:
        """Start both threads."""
        self.cutter.start()
        super().start()

    def run(self) -> None:
        """Read until `close` is called or the port fails."""
        try:
            while not self._stopping.is_set():
                self._turn()
                self._drain()
            reason = "it was closed"
        except _HungUpError as error:
            reason = f"{error}"
        except BaseException as error:
            logger.exception("the %s failed", self.name, extra=coded(DRIVER_FAILED))
            reason = self._failed(error)
        self._jobs.put(partial(self._post, self._end, reason))
        self._jobs.put(None)

    def close(self) -> None:
        """Stop reading and close the port; may take a while, as closing a port may."""
        self._stopping.set()
        self.join(SHUTDOWN_S)
        if self.is_alive():
            logger.warning(
                "the %s hangs in the port and is left behind", self.name, extra=coded(STOPPED_HARD)
            )
            self._jobs.put(None)
        self.cutter.join(SHUTDOWN_S)
        close_port(self._device)

    def finish(self) -> None:
        """Take in at once what has been handed over; on the event loop, once it is closed."""
        self._hand.finish()

    def _cut_on(self) -> None:
        """Do what the reading thread asks for, in turn."""
        try:
            while (job := self._jobs.get()) is not None:
                job()
        except BaseException as error:
            logger.exception("the %s failed", self.cutter.name, extra=coded(DRIVER_FAILED))
            self._stopping.set()
            self._post(self._end, self._failed(error))

    def _failed(self, error: BaseException) -> str:
        """Count a failure of one of the threads, and put it into words."""
        self._post(self._receiver.note, "reader_failures")
        return f"its reader failed: {error or type(error).__name__}"

    def _drain(self) -> None:
        """Gather what comes within `GATHER_NS`, or a batch of it, and have it cut.

        Raises:
            _HungUpError: the port is gone; what was read before has been handed over.
        """
        asked_ns = self._clock.monotonic_ns()
        if not self._poll.poll(POLL_MS):
            # Asked before the port was: whatever came until then has been seen by now.
            self._look_at_line(asked_ns)
            self._jobs.put(partial(self._post, self._receiver.tick, asked_ns))
            return
        chunks: list[bytes] = []
        arrival_ns: list[int] = []
        gathered = 0
        failure: _HungUpError | None = None
        # Real time, whatever the service's clock is: this is about how many turns a second cost.
        # A length drawn at random, or a port that keeps step with it has the same stream stamped each time.
        until_ns = time.monotonic_ns() + round(GATHER_NS * self._rng.uniform(0.9, 1.0))
        self._pauses.listen()
        while gathered < BATCH_BYTES:
            try:
                chunk = self._read()
            except _HungUpError as error:
                failure = error
                break
            if chunk:
                arrival_ns.append(self._clock.monotonic_ns())
                chunks.append(chunk)
                gathered += len(chunk)
            now_ns = time.monotonic_ns()
            left_ms = (until_ns - now_ns) // 1_000_000
            if left_ms <= 0:
                break
            if chunk and (pause_s := self._pauses.after(chunk, now_ns)):
                time.sleep(min(pause_s, left_ms / 1000))
            elif not self._poll.poll(left_ms):
                break
        if chunks and self._may_hand_over():
            self._jobs.put(partial(self._cut, chunks, arrival_ns))
        if failure is not None:
            raise failure
        self._look_at_line(asked_ns)

    def _read(self) -> bytes:
        """What is there; nothing if another took it.

        Raises:
            _HungUpError: the port is gone.
        """
        try:
            chunk = os.read(self._fd, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return b""
        except OSError as error:
            why = "it is gone (unplugged, or its device was reset)" if error.errno in GONE else f"{error}"
            raise _HungUpError(why) from error
        if not chunk:
            raise _HungUpError("it has hung up (unplugged, or its device was reset)")
        return chunk

    def _cut(self, chunks: list[bytes], arrival_ns: list[int]) -> None:
        """Find and decode the frames in what was read, and hand them to the event loop."""
        chunk_ends = np.cumsum([len(chunk) for chunk in chunks])
        chunk_ns = np.array(arrival_ns, np.int64)

        def arrivals_of(ends: NDArray[np.int64]) -> NDArray[np.int64]:
            # A frame is there when its last byte is.
            chunk = np.searchsorted(chunk_ends, ends, "left").clip(0, len(chunk_ns) - 1)
            return np.take(chunk_ns, chunk)

        batch = self._framing.cut(b"".join(chunks), arrivals_of)
        batch.note("bytes_received", int(chunk_ends[-1]))
        self._post(self._accept, batch)

    def _look_at_line(self, now_ns: int) -> None:
        """Count what the UART has found wrong since the last poll."""
        if self._line_errors is None or now_ns < self._line_errors_due_ns:
            return
        self._line_errors_due_ns = now_ns + LINE_ERRORS_EVERY_NS
        before, now = self._line_errors, line_errors(self._fd)
        if now is None:
            return
        self._line_errors = now
        for name, earlier, later in zip(LineErrors._fields, before, now, strict=True):
            if later != earlier:
                self._post(self._receiver.note, name, (later - earlier) % 2**32)

    def _may_hand_over(self) -> bool:
        """Wait until the event loop has room for another batch; False if the wait was ended by `close`."""
        if self._under_way.acquire(blocking=False):
            return True
        self._post(self._receiver.note, "stalls")
        while not self._under_way.acquire(timeout=POLL_MS / 1000):
            if self._stopping.is_set():
                return False
        return True

    def _accept(self, batch: DecodedBatch) -> None:
        self._under_way.release()
        self._receiver.accept(batch)

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)

    def _post(self, call: Any, *arguments: object) -> None:
        try:
            self._hand.post(call, *arguments)
        except RuntimeError:  # the event loop is closed: nothing takes the call any more
            self._stopping.set()


def close_port(device: serial.Serial) -> None:
    """Close a port that may be gone; may block, so not for the event loop."""
    try:
        device.close()
    except OSError as error:  # a port that is gone may fail to close in its own way
        logger.info("closing serial port %s, which is gone: %s", device.port, error)


def line_errors(fd: int) -> LineErrors | None:
    """The UART's counts; None if the port has none, as pseudo-terminals and many USB adapters."""
    counts = array.array("i", [0] * 20)
    try:
        fcntl.ioctl(fd, TIOCGICOUNT, counts)
    except OSError:
        return None
    # In the order of struct serial_icounter_struct: cts, dsr, rng, dcd, rx, tx, frame, overrun, ...
    frame, overrun, parity, brk, buf_overrun = counts[6:11]
    return LineErrors(frame, overrun + buf_overrun, parity, brk)
