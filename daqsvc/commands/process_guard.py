"""The process around a service: its signals, its terminal, and the way out if something hangs.

A thread hears the signals, so that a stop is carried out whatever the event loop does, and sees that the loop
turns and that a stop comes to its end. Time is counted in the thread's own turns: a process that was
suspended was neither blocked nor late to stop.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import threading
from typing import TYPE_CHECKING, Self

from daqsvc.commands import early_signals
from daqsvc.commands.arguments import EXIT_HUNG, EXIT_STUCK
from daqsvc.errors.code import coded
from daqsvc.errors.service import PART_FAILED, PART_STALLED, STOPPED_HARD
from daqsvc.notice import notice
from daqsvc.threads import where_is

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

log = logging.getLogger(__name__)


USER_SIGNALS = (signal.SIGUSR1, signal.SIGUSR2)
"""They would end the process, and mean nothing to it."""

TURN_S = 0.1
STOP_TURNS = 17
"""Turns that a stop may take before it is forced, which leaves `CLOSE_S` of its two seconds."""

CLOSE_S = 0.3
"""What the journal may take to close at the last moment."""

STUCK_TURNS = 300
"""Turns that the event loop may stand still."""

SAY_S = 0.2
"""Time to write the last line: its reader may hang, too."""

LINGER_S = 1.0
"""What threads of others may take to end when all else has."""


class ProcessGuard:
    """Ends the process when it is asked to, in order if possible.

    Use it as a context manager around the event loop, on the main thread.

    Args:
        flush: waits for the log to be written, at most so many seconds.
        on_stopping: called once when the service begins to stop, on any thread.
        end: ends the process with an exit code.
    """

    def __init__(
        self,
        flush: Callable[[float], None] = lambda _: None,
        on_stopping: Callable[[], object] = lambda: None,
        end: Callable[[int], object] = os._exit,
    ) -> None:
        self._flush = flush
        self._on_stopping = on_stopping
        self._end_process = end
        self._stop: Callable[[], None] | None = None
        self._reload: Callable[[], object] | None = None
        self._reload_asked = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._close: Callable[[float], bool] | None = None
        self._main = threading.get_ident()
        self._others = set(threading.enumerate())
        self._thread = threading.Thread(target=self._watch, name="process guard", daemon=True)
        self._heard, self._tell = os.pipe()
        self._turns_stopping: int | None = None
        self._turns_still: int | None = None
        self._turns_to_report: int | None = None
        self._answered = True
        self._over = False
        self._outlives_terminal = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        self._terminals = [fd for fd in (0, 1, 2) if _is_terminal(fd)]

    def __enter__(self) -> Self:
        os.set_blocking(self._tell, False)
        self._wakeup_before = signal.set_wakeup_fd(self._tell, warn_on_full_buffer=False)
        self._before = {
            number: signal.signal(number, self._signalled) for number in (signal.SIGTERM, signal.SIGINT)
        }
        if not self._outlives_terminal:
            # Only that there is a handler: the thread hears it.
            self._before[signal.SIGHUP] = signal.signal(signal.SIGHUP, lambda *_: None)
        for number in USER_SIGNALS:
            self._before[number] = signal.signal(number, lambda *_: None)
        self._thread.start()
        if early_signals.take_hang_up() and not self._outlives_terminal:
            # The machine files may have been read before it came.
            self._hear(signal.SIGHUP)
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        with contextlib.suppress(OSError):
            os.write(self._tell, b"\0")
        self._thread.join()
        signal.set_wakeup_fd(self._wakeup_before)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._heard)
        os.close(self._tell)
        lingering = [
            thread for thread in threading.enumerate() if not thread.daemon and thread not in self._others
        ]
        if lingering:
            threading.Thread(target=self._end_soon, args=(lingering,), daemon=True).start()

    def stop_by(self, loop: asyncio.AbstractEventLoop, stop: Callable[[], None]) -> None:
        """Say how the service is asked to stop; called on its event loop."""
        self._stop, self._loop = stop, loop
        if self._turns_stopping is not None:
            stop()

    def reload_by(self, reload: Callable[[], object]) -> None:
        """Set what SIGHUP does on the event loop; called there. One that came before is carried out now."""
        self._reload = reload
        # In this order, as `_hear` has the other: of one that comes right now twice is better than never.
        if self._reload_asked:
            self._reload_asked = False
            reload()

    def protect(self, close: Callable[[float], bool]) -> None:
        """Say what must be done before the process may be ended by force.

        Args:
            close: blocks for at most so many seconds, on any thread; whether all is on disk.
        """
        self._close = close

    def expect_turns(self, say_after_s: float | None = None) -> None:
        """From now on the event loop turns; one that stands still is ended.

        Args:
            say_after_s: after so long it is logged, since a supervisor outside may end the process
                before the guard does.
        """
        self._turns_to_report = None if say_after_s is None else max(1, round(say_after_s / TURN_S))
        self._turns_still = 0

    def stopping(self) -> None:
        """The service has begun to stop, for whatever reason; from any thread."""
        if self._turns_stopping is None:
            self._turns_stopping = 0
            self._on_stopping()

    def lose_terminal(self, reason: str) -> None:
        """Stop because the terminal or supervisor of the process is gone; from any thread."""
        if not self._outlives_terminal:
            self._ask_to_stop(f"{reason}; the service stops")

    # On the thread.

    def _watch(self) -> None:
        while not self._over:
            try:
                self._turn()
            except BaseException:
                log.exception("the guard of the process has failed; it goes on", extra=coded(PART_FAILED))

    def _turn(self) -> None:
        heard, _, _ = select.select([self._heard], [], [], TURN_S)
        if heard:
            for number in os.read(self._heard, 64):
                self._hear(number)
            return
        if self._turns_stopping is not None:
            self._turns_stopping += 1
            if self._turns_stopping > STOP_TURNS:
                self._end(EXIT_HUNG, f"the service did not stop in time and is ended: {self._what_hangs()}")
        elif self._turns_still is not None and self._loop is not None:
            self._see_whether_loop_turns(self._loop)

    def _see_whether_loop_turns(self, loop: asyncio.AbstractEventLoop) -> None:
        if self._answered:
            self._answered, self._turns_still = False, 0
            with contextlib.suppress(RuntimeError):  # it is closed already
                loop.call_soon_threadsafe(self._answer)
            return
        self._turns_still = (self._turns_still or 0) + 1
        if self._turns_still == self._turns_to_report:
            still_s = self._turns_to_report * TURN_S
            self._say(f"the event loop has been blocked for {still_s:g} s: {self._where_loop_is()}")
        if self._turns_still > STUCK_TURNS:
            still_s = STUCK_TURNS * TURN_S
            self._end(
                EXIT_STUCK, f"the event loop has been blocked for {still_s:g} s: {self._where_loop_is()}"
            )

    def _answer(self) -> None:
        self._answered = True

    def _signalled(self, number: int, _frame: object) -> None:
        """On the main thread, as soon as that gets round to it: should the thread have missed it."""
        self._hear(number)

    def _hear(self, number: int) -> None:
        if number in {signal.SIGTERM, signal.SIGINT}:
            self._ask_to_stop("")
        elif number in USER_SIGNALS:
            notice(log, "%s is ignored: it means nothing to the service", signal.Signals(number).name)
        elif number == signal.SIGHUP:
            if any(_is_gone(fd) for fd in self._terminals):
                self.lose_terminal("the terminal is gone")
            else:
                self._hear_reload()

    def _hear_reload(self) -> None:
        is_first, self._reload_asked = not self._reload_asked, True
        if self._reload is not None and self._loop is not None:
            self._reload_asked = False
            with contextlib.suppress(RuntimeError):  # the loop is closed already
                self._loop.call_soon_threadsafe(self._reload)
        elif is_first:
            notice(log, "SIGHUP: the service starts; it reads its machine files again when it is ready")

    def _ask_to_stop(self, why: str) -> None:
        if self._turns_stopping is not None:
            return
        if why:
            notice(log, "%s", why)
        self.stopping()
        if self._loop is None or self._stop is None:
            # Nothing is open yet that would have to be closed.
            self._flush(SAY_S)
            self._end_process(0)
            return
        with contextlib.suppress(RuntimeError):  # it is closed already
            self._loop.call_soon_threadsafe(self._stop)

    def _end(self, code: int, sentence: str) -> None:
        closed = self._close is None or self._close(CLOSE_S)
        journal = "" if closed else "; the journal could not be closed"
        self._say(f"{sentence}{journal}")
        self._over = True
        self._end_process(code)

    def _say(self, sentence: str) -> None:
        # The log's lock may be held by what hangs.
        kind = {"extra": coded(PART_STALLED)}
        saying = threading.Thread(target=log.critical, args=("%s", sentence), kwargs=kind, daemon=True)
        saying.start()
        saying.join(SAY_S)
        self._flush(SAY_S)

    def _what_hangs(self) -> str:
        threads = [t.name for t in threading.enumerate() if not t.daemon and t not in self._others]
        hanging = f"threads {', '.join(threads)}; " if threads else ""
        return f"{hanging}{self._where_loop_is()}"

    def _where_loop_is(self) -> str:
        return f"the event loop is in {where_is(self._main)}"

    def _end_soon(self, lingering: list[threading.Thread]) -> None:
        for thread in lingering:
            thread.join(LINGER_S / len(lingering))
        left = [thread.name for thread in lingering if thread.is_alive()]
        if left:
            log.critical(
                "threads %s do not end; the process is ended", ", ".join(left), extra=coded(STOPPED_HARD)
            )
            self._flush(SAY_S)
            self._end_process(EXIT_HUNG)


def _is_terminal(fd: int) -> bool:
    try:
        return os.isatty(fd)
    except OSError:
        return False


def _is_gone(fd: int) -> bool:
    """Whether a terminal has hung up."""
    poll = select.poll()
    poll.register(fd, 0)  # hang-ups are always reported
    return any(event & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, event in poll.poll(0))
