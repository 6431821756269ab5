"""The recording of a CAN bus: every frame that the reader receives, in order, into log files.

Its own thread writes. It is handed frames in batches and never waited for: what it cannot keep up
with, or the disk refuses, is left out and counted, and the bus is read on.
"""

from __future__ import annotations

import logging
import queue
import re
import threading
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.errors.buses import FRAMES_UNRECORDED
from daqsvc.errors.code import coded
from drivers.can.kernel_time import monotonic_minus_wall_ns
from drivers.can.record_files import LogFile, LogFolder, encoder_for
from drivers.reconnect import words

if TYPE_CHECKING:
    from daqsvc.acquisition.clock import Clock
    from drivers.base import BusPort
    from drivers.can.batches import CanBatch
    from drivers.can.errors import CanCounters
    from drivers.can.record_files import Logs
    from drivers.can.settings import CanBus

logger = logging.getLogger(__name__)

MOST_FRAMES_HELD = 1 << 16
"""In memory and not yet written: more than a second of anything that a CAN bus carries."""

GATHERED_FRAMES = 8192
RETRY_NS = NS_PER_S
WELL_NS = 10 * NS_PER_S
"""How long a disk must have taken everything to be well: a full one takes a little now and then."""

IDLE_S = 0.5
PATIENCE_S = 1.0
"""How long a disk may take to write the rest when the bus is closed."""

_INTERFACE = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")
_BYTES_PER_MB = 1_000_000


class CanRecorder:
    """Records what it is handed until closed.

    At any time, *frames handed over = frames_recorded + frames_unrecorded + frames held in memory*; at its
    end none are held.

    Args:
        link_name: what a person calls the bus.
        interface: what logs call it.
        logs: where the recording goes.
        clock: the service's clock; its wall time labels the frames.
        counters: what is counted on; only the recorder changes these two figures.
    """

    def __init__(
        self, link_name: str, interface: str, logs: Logs, clock: Clock, counters: CanCounters
    ) -> None:
        self._link_name = link_name
        self._interface = interface
        self._logs = logs
        self._clock = clock
        self._counters = counters
        self._lock = threading.Lock()
        self._held = 0
        self._closed = False
        self._ending = False
        self._too_slow = False
        self._queue: queue.SimpleQueue[CanBatch | None] = queue.SimpleQueue()
        self._thread = self._new_thread()
        self._log: LogFile | None = None
        self._pending = 0
        self._flushed_ns = 0
        self._failed_ns: int | None = None
        self._well_since_ns: int | None = None
        self._missing = 0

    def start(self) -> None:
        """Begin; the first file is made when the first frame comes."""
        self._thread.start()

    def record(self, batch: CanBatch) -> None:
        """Record frames; called by the thread that reads the bus, and never waits."""
        frames = len(batch.ids)
        if not frames:
            return
        if self._is_lost():
            self._begin_again()
        with self._lock:
            too_many = self._held + frames > MOST_FRAMES_HELD
            left_out = too_many or self._closed
            if left_out:
                self._counters.frames_unrecorded += frames
            else:
                self._held += frames
        if not left_out:
            self._queue.put(batch.kept())
        elif too_many and not self._too_slow:
            self._too_slow = True
            logger.warning(
                "%s: its frames come faster than they can be recorded in %s; those left out are counted in "
                "frames_unrecorded from now on. Take a faster disk, or have the bus filtered",
                self._link_name,
                self._logs.place,
                extra=coded(FRAMES_UNRECORDED),
            )

    def close(self) -> None:
        """Write the rest and end the file; blocks for `PATIENCE_S` at most."""
        self._ending = True
        self._queue.put(None)
        self._thread.join(PATIENCE_S)
        with self._lock:
            self._closed = True
            left, self._held = self._held, 0
            self._counters.frames_unrecorded += left
        if self._thread.is_alive():
            logger.warning(
                "%s: its last %d frames could not be recorded in %s within %g s and are given up; the disk "
                "hangs or is too slow",
                self._link_name,
                left,
                self._logs.place,
                PATIENCE_S,
                extra=coded(FRAMES_UNRECORDED),
            )

    def _new_thread(self) -> threading.Thread:
        return threading.Thread(target=self._record_on, name=f"can-recorder {self._link_name}", daemon=True)

    def _is_lost(self) -> bool:
        """Whether the thread has ended, which it does only when it has to stop."""
        return self._thread.ident is not None and not self._thread.is_alive() and not self._ending

    def _begin_again(self) -> None:
        """Go on in a new thread and a new file; what the thread that is gone was handed is lost."""
        with self._lock:
            lost, self._held = self._held, 0
            self._counters.frames_unrecorded += lost
            self._counters.recorder_failures += 1
        self._queue, self._pending, self._log = queue.SimpleQueue(), 0, None
        logger.error(
            "%s: the thread that records it in %s was lost, and %d frames with it; another one goes on",
            self._link_name,
            self._logs.place,
            lost,
            extra=coded(FRAMES_UNRECORDED),
        )
        self._thread = self._new_thread()
        self._thread.start()

    def _record_on(self) -> None:
        try:
            self._write_all()
        except BaseException:
            logger.exception(
                "the thread that records %s has failed", self._link_name, extra=coded(FRAMES_UNRECORDED)
            )
            self._end_log()

    def _write_all(self) -> None:
        while not self._closed:
            try:
                batch = self._queue.get(timeout=IDLE_S)
            except queue.Empty:
                self._flush()
                continue
            if batch is None:
                self._flush()
                break
            self._write(batch)
        self._end_log()

    def _write(self, batch: CanBatch) -> None:
        now_ns = self._clock.monotonic_ns()
        if self._failed_ns is not None and self._log is None and now_ns - self._failed_ns < RETRY_NS:
            self._settle(unrecorded=len(batch.ids))
            return
        self._pending += len(batch.ids)
        try:
            if self._log is None:
                self._log = self._begin_log(batch)
            self._log.add(batch)
        except Exception as error:  # noqa: BLE001 - writers of formats raise what they like
            self._fail(error)
            return
        if self._pending >= GATHERED_FRAMES or now_ns - self._flushed_ns >= self._log.flush_ns:
            self._flush()

    def _begin_log(self, batch: CanBatch) -> LogFile:
        offset_ns = -monotonic_minus_wall_ns(self._clock)[0]
        path = self._logs.next_path(int(batch.arrival_ns[0]) + offset_ns)
        return LogFile(path, encoder_for(self._logs.log_format, self._interface), offset_ns)

    def _flush(self) -> None:
        if self._log is None or not self._pending:
            return
        try:
            self._log.flush()
        except Exception as error:  # noqa: BLE001 - as above
            self._fail(error)
            return
        self._flushed_ns = self._clock.monotonic_ns()
        self._settle(recorded=self._pending)
        self._pending = 0
        if self._failed_ns is not None:
            self._get_well(self._log)
        if self._log.size >= self._logs.file_bytes or self._log.deleted:
            self._end_log()

    def _get_well(self, log: LogFile) -> None:
        if self._well_since_ns is None:
            self._well_since_ns = self._flushed_ns
        if self._flushed_ns - self._well_since_ns >= WELL_NS:
            logger.warning(
                "%s is recorded again in %s; %d frames are missing from the recording",
                self._link_name,
                log.path,
                self._missing,
                extra=coded(FRAMES_UNRECORDED),
            )
            self._failed_ns, self._missing = None, 0

    def _fail(self, error: Exception) -> None:
        """Leave out what is not on disk yet; tried again in a new file, for this one may be the reason."""
        if self._failed_ns is None:
            logger.warning(
                "%s cannot be recorded in %s: %s; its frames are counted in frames_unrecorded until it can. "
                "Check that the disk has room and can be written",
                self._link_name,
                self._logs.place,
                words(error),
                extra=coded(FRAMES_UNRECORDED),
            )
        self._failed_ns, self._well_since_ns = self._clock.monotonic_ns(), None
        self._settle(unrecorded=self._pending)
        self._pending = 0
        self._end_log()

    def _settle(self, *, recorded: int = 0, unrecorded: int = 0) -> None:
        """Count frames that are held no longer; not those that were given up meanwhile."""
        self._missing += unrecorded
        with self._lock:
            if not self._closed:
                self._held -= recorded + unrecorded
                self._counters.frames_recorded += recorded
                self._counters.frames_unrecorded += unrecorded

    def _end_log(self) -> None:
        log, self._log = self._log, None
        if log is None:
            return
        try:
            log.close()
        except OSError as error:
            logger.info("%s: closing %s: %s; what is in it stays", self._link_name, log.path, words(error))


def recorder_of(
    bus: CanBus, port: BusPort, link_name: str, counters: CanCounters, logs: Logs | None = None
) -> CanRecorder | None:
    """The recorder of a bus; None if it is not to be recorded.

    Args:
        bus: its table in the machine file.
        port: its name and the clock.
        link_name: what a person calls it.
        counters: where recorded frames are counted.
        logs: where the recording goes, if not where the table states.
    """
    if logs is None:
        if bus.record is None:
            return None
        logs = LogFolder(
            bus.record.folder,
            port.name,
            bus.record.format,
            file_bytes=bus.record.file_mb * _BYTES_PER_MB,
            keep_bytes=bus.record.keep_mb * _BYTES_PER_MB,
        )
    if not bus.fd and bus.interface != "socketcan":
        logger.warning(
            "%s: CAN FD frames are neither read nor recorded, and not counted as unrecorded: the machine "
            "file has fd = false. Set fd = true if the bus carries any",
            link_name,
            extra=coded(FRAMES_UNRECORDED),
        )
    # Virtual buses are called by a path, which is no word of a log.
    interface = bus.channel if _INTERFACE.fullmatch(bus.channel) else port.name
    return CanRecorder(link_name, interface, logs, port.clock, counters)
