"""Supervision: no part of the service ends another; what ends is logged, counted and started again.

A part is a task of the event loop under a name. It is watched by a callback and not by another task, so
nothing that ends a task ends its supervision. ``docs/architecture.md`` has who restarts what.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff, LoggedOnce
from daqsvc.errors.code import coded
from daqsvc.errors.service import ESSENTIAL_LOST, PART_FAILED, PART_STALLED, STOPPED_HARD
from daqsvc.notice import notice
from daqsvc.settings.failures import BrokenContractError, ExitRaisedError, cause_of, error_text, in_words
from daqsvc.threads import kept_waiting_s, where_is

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping

    Work = Callable[[], Coroutine[Any, Any, None]]

logger = logging.getLogger(__name__)

WELL_S = 60.0
"""A part that has run for so long has earned a quick restart."""

OTHERS = "event loop"
"""The name under which failures of callbacks, and of tasks that are not waited for, are counted."""


class EssentialLostError(Exception):
    """Something without which the service is useless is gone for good; the text states what, and why."""

    code = ESSENTIAL_LOST


class Supervisor:
    """Keeps parts going, and the count of what went wrong with them.

    Attributes:
        failures: by part, how often it has failed; for threads to add to as well, by `failed`.
    """

    def __init__(self) -> None:
        self.failures: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._logged = LoggedOnce()
        self._lost: asyncio.Future[None] | None = None

    def keep(
        self,
        name: str,
        work: Work,
        *,
        may_end: Callable[[], bool] = lambda: False,
        fatal: tuple[type[Exception], ...] = (),
    ) -> Part:
        """Run a part, and start it again, with growing waits, whenever it ends unasked.

        Args:
            name: of the part, in words, e.g. ``"driver can0"``.
            work: makes the coroutine; once for each start.
            may_end: asked when it returns: whether that is its proper end.
            fatal: exceptions that end the service if they come out of its first start.
        """
        part = Part(self, name, work, may_end, fatal)
        part.start()
        return part

    def within(self, machine: str) -> Supervisor:
        """The same for the parts of one machine, whose names have that of the machine in front."""
        return _Within(self, machine)

    def named(self, name: str) -> str:
        """What a part is called in the log and in the count of failures."""
        return name

    def failed(self, name: str, error: BaseException | str, then: str) -> None:
        """Count a failure, and log it in one line, but the same one once an hour only; from any thread.

        Args:
            name: whose.
            error: what it was; an exception's traceback is logged as well, for who logs what goes well, too.
            then: what is done about it, e.g. ``"it is started again"``.
        """
        with self._lock:
            self.failures[name] += 1
            count = self.failures[name]
            if not self._logged.may_say((name, error if isinstance(error, str) else cause_of(error))):
                return
        what = error if isinstance(error, str) else in_words(error)
        times = "" if count == 1 else f" (failure {count} of it)"
        logger.error("%s: %s; %s%s", name, what, then, times, extra=coded(PART_FAILED))
        if isinstance(error, BaseException) and error.__traceback__ is not None:
            logger.info("traceback of that failure", exc_info=error)

    @contextlib.contextmanager
    def sparing_others(self, name: str, then: str) -> Iterator[None]:
        """Let no exception out of a piece of work, on which others depend that have nothing to do with it."""
        try:
            yield
        except (Exception, SystemExit) as error:  # noqa: BLE001 - logged and counted there
            self.failed(name, error, then)

    @property
    def lost(self) -> asyncio.Future[None]:
        """What becomes the exception with which the service must end; else it stays undone."""
        if self._lost is None:
            self._lost = asyncio.get_running_loop().create_future()
            # Examined, so that a loss that comes while the service ends is not reported as unseen.
            self._lost.add_done_callback(lambda lost: lost.cancelled() or lost.exception())
        return self._lost

    def give_up(self, error: Exception) -> None:
        """Have the service end; on the event loop."""
        if not self.lost.done():
            self.lost.set_exception(error)

    @contextlib.contextmanager
    def hearing(self) -> Iterator[None]:
        """Count and log what fails in callbacks, in tasks that are not waited for, and in bare threads."""
        loop = asyncio.get_running_loop()
        loop_before, threads_before = loop.get_exception_handler(), threading.excepthook
        loop.set_exception_handler(self._hear_loop)
        threading.excepthook = self._hear_thread
        try:
            yield
        finally:
            threading.excepthook = threads_before
            loop.set_exception_handler(loop_before)

    def _hear_loop(self, _loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error, message = context.get("exception"), context.get("message", "something failed")
        text = message if error is None else f"{message}: {in_words(error)}"
        self.failed(OTHERS, text, "the rest goes on")
        if error is not None:
            logger.info("traceback of that failure", exc_info=error)

    def _hear_thread(self, failure: threading.ExceptHookArgs) -> None:
        name = "thread" if failure.thread is None else f"thread {failure.thread.name}"
        self.failed(name, failure.exc_value or failure.exc_type.__name__, "it has ended")


class _Within(Supervisor):
    """See `Supervisor.within`."""

    def __init__(self, whole: Supervisor, machine: str) -> None:
        super().__init__()
        self.failures = whole.failures
        self._whole = whole
        self._machine = machine

    def named(self, name: str) -> str:
        return f"{self._machine}: {name}"

    def keep(
        self,
        name: str,
        work: Work,
        *,
        may_end: Callable[[], bool] = lambda: False,
        fatal: tuple[type[Exception], ...] = (),
    ) -> Part:
        return self._whole.keep(self.named(name), work, may_end=may_end, fatal=fatal)

    def failed(self, name: str, error: BaseException | str, then: str) -> None:
        self._whole.failed(self.named(name), error, then)

    @property
    def lost(self) -> asyncio.Future[None]:
        return self._whole.lost


class Part:
    """A task that is started again; see `Supervisor.keep`.

    Attributes:
        name: of the part.
        over: done when it has ended for good.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        name: str,
        work: Work,
        may_end: Callable[[], bool],
        fatal: tuple[type[Exception], ...],
    ) -> None:
        self.name = name
        self._loop = asyncio.get_running_loop()
        self.over: asyncio.Future[None] = self._loop.create_future()
        self._supervisor = supervisor
        self._work = work
        self._may_end = may_end
        self._fatal = fatal
        self._backoff = Backoff()
        self._task: asyncio.Task[None] | None = None
        self._waiting: asyncio.TimerHandle | None = None
        self._started_s = 0.0
        self._stopping = False

    def start(self) -> None:
        """Start the task."""
        self._started_s = self._loop.time()
        self._waiting = None
        self._task = self._loop.create_task(self._run(), name=self.name)
        self._task.add_done_callback(self._ended)

    def stop(self) -> None:
        """Cancel the task and do not start it again."""
        self._stopping = True
        if self._waiting is not None:
            self._waiting.cancel()
            self._finish()
        elif self._task is not None:
            self._task.cancel()

    def leave(self) -> None:
        """Do not start the task again when it ends."""
        self._stopping = True
        if self._waiting is not None:
            self._waiting.cancel()
            self._finish()

    async def _run(self) -> None:
        # Here, so that a call that fails before there is a coroutine is a failure of the part, too.
        try:
            await self._work()
        except SystemExit as error:  # out of a task it would end the event loop, and all other parts with it
            raise ExitRaisedError(error_text(error)).with_traceback(error.__traceback__) from None

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._task = None
        error = None if task.cancelled() else task.exception()
        if self._stopping:
            if error is not None:
                self._supervisor.failed(self.name, error, "the service is stopping anyway")
            self._finish()
        elif isinstance(error, self._fatal):
            self._supervisor.give_up(error)
            self._finish()
        elif not task.cancelled() and error is None and self._may_end():
            self._finish()
        else:
            by_itself = BrokenContractError(self._work, "it has ended by itself")
            what = "it was cancelled" if task.cancelled() else error or by_itself
            self._supervisor.failed(self.name, what, "it is started again")
            self._start_again()

    def _start_again(self) -> None:
        self._fatal = ()
        if self._loop.time() - self._started_s > WELL_S:
            self._backoff.reset()
        self._waiting = self._loop.call_later(self._backoff.next_ns() / NS_PER_S, self.start)

    def _finish(self) -> None:
        if not self.over.done():
            self.over.set_result(None)


MOST_LOOK_S = 2.0
"""Longest time between two checks that counts: a process that was suspended has not stalled."""


class Progress(NamedTuple):
    """How far a part has come.

    Attributes:
        step: other after every step of it; None while it has nothing to do.
        thread: what it works in, if that is known.
    """

    step: object
    thread: threading.Thread | None = None


@dataclass(slots=True)
class _Standstill:
    step: object
    still_s: float = 0.0
    waited_s: float = 0.0
    is_reported: bool = False


class StallWatch:
    """Finds parts that have something to do and get nowhere, for all who act on that, and states each once.

    Time is counted from look to look, and without what a part's thread has waited for a processor. Where
    the whole process runs slowly, or not at all for a while, no part of it has stalled.

    Args:
        progress: by name, how far each part has come.
    """

    def __init__(self, progress: Callable[[], Mapping[str, Progress]]) -> None:
        self.progress = progress
        self._limits: list[tuple[float, str]] = []
        self._looked_s: float | None = None
        self._parts: dict[str, _Standstill] = {}

    def hold_to(self, limit_s: float, then: str) -> Callable[[float], list[str]]:
        """What finds the parts that have stalled; to be called now and then with the monotonic clock in s.

        Args:
            limit_s: without a step for so long, a part has stalled.
            then: what follows, for the log, e.g. ``"the service is started again"``.
        """
        self._limits = sorted([*self._limits, (limit_s, then)])
        return partial(self._look, limit_s)

    def _look(self, limit_s: float, now_s: float) -> list[str]:
        passed_s = 0.0 if self._looked_s is None else min(now_s - self._looked_s, MOST_LOOK_S)
        self._looked_s = now_s
        stalled: list[str] = []
        for name, (step, thread) in self.progress().items():
            waited_s = 0.0 if thread is None else kept_waiting_s(thread)
            before = self._parts.get(name)
            if before is None or step is None or step != before.step:
                if before is not None and before.is_reported:
                    notice(logger, "%s works again", name)
                self._parts[name] = _Standstill(step, waited_s=waited_s)
                continue
            before.still_s += max(0.0, passed_s - max(0.0, waited_s - before.waited_s))
            before.waited_s = waited_s
            if before.still_s < limit_s:
                continue
            stalled.append(name)
            if not before.is_reported:
                before.is_reported = True
                then = "; after ".join(f"{limit:g} s: {then}" for limit, then in self._limits)
                where = "" if thread is None else f"; its thread is in {where_is(thread.ident)}"
                logger.critical(
                    "%s has stalled, without a step for %s%s", name, then, where, extra=coded(PART_STALLED)
                )
        return stalled


async def stop_all(parts: Iterable[Part], patience_s: float) -> None:
    """Stop parts, and wait for their end at most so long; log which ones hang."""
    parts = list(parts)
    for part in parts:
        part.stop()
    await over(parts, patience_s)
    for part in parts:
        if not part.over.done():
            logger.error(
                "%s does not stop within %g s and is left behind",
                part.name,
                patience_s,
                extra=coded(STOPPED_HARD),
            )


async def over(parts: Iterable[Part], patience_s: float | None = None) -> None:
    """Wait until parts have ended for good, at most so long."""
    waited_for = {part.over for part in parts}
    if waited_for:
        await asyncio.wait(waited_for, timeout=patience_s)
