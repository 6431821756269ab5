"""What all drivers have in common: a link that is tried again, and threads that end in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

from daqsvc.acquisition.link import Backoff
from daqsvc.errors.buses import DRIVER_FAILED
from daqsvc.errors.code import coded
from daqsvc.settings.failures import BrokenContractError, message_of
from daqsvc.threads import call_in_thread
from drivers.base import DeviceAbsentError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from concurrent.futures import Future
    from threading import Thread

    from daqsvc.acquisition.link import Link
    from drivers.base import BusCounters, BusPort


logger = logging.getLogger(__name__)

T = TypeVar("T")


LOOK_S = 1.0
"""How often to look whether a thread that is waited for still lives."""


class Attempt(NamedTuple):
    """How an attempt at a link went.

    Attributes:
        present: whether the device was there.
        useful: whether anything came from it: a link that opens and fails at once is not back.
        reason: why the attempt ended.
        error: the unexpected error that its driver has failed with.
    """

    present: bool
    useful: bool
    reason: str
    error: BaseException | None = None


class CannotOpenError(Exception):
    """The link cannot be opened; states why, and what to do about it."""


async def run_with_reconnect(
    link: Link,
    port: BusPort,
    attempt: Callable[[], Awaitable[Attempt | None]],
) -> None:
    """Try a link again and again, each time later unless something came over it; until cancelled.

    An attempt that fails unexpectedly is logged once, with its plugin and line, and tried
    again like any other. What to do about a device that is absent at first holds until it has been there
    once, also if this is called again.

    Args:
        link: its state; `attempt` states when it is up.
        port: what to do if the device is absent at first, and the clock.
        attempt: opens the link and uses it until it is lost; None if there is nothing more to come. It may
            raise `CannotOpenError`, but must not put the link down: that is reported here, where it is known
            whether it is tried again.

    Raises:
        DeviceAbsentError: the device is absent at start and the policy is ``"error"``.
    """
    backoff = Backoff()
    first = not link.ever_up
    while (outcome := await _outcome(attempt)) is not None:
        if first and not outcome.present and port.start == "error":
            raise DeviceAbsentError(f"{link.name}: {outcome.reason}")
        if first and not outcome.present and port.start == "ignore":
            link.leave_out(outcome.reason)
            return
        first = False
        if outcome.error is None:
            link.down(outcome.reason)
        else:
            link.fail(outcome.reason, outcome.error)
        if outcome.useful:
            backoff.reset()
        await port.clock.sleep_ns(backoff.next_ns())


async def _outcome(attempt: Callable[[], Awaitable[Attempt | None]]) -> Attempt | None:
    try:
        outcome = await attempt()
    except CannotOpenError as error:
        return Attempt(present=False, useful=False, reason=f"{error}")
    except (Exception, SystemExit) as error:  # noqa: BLE001 - reported by the link
        return _failed(error)
    if outcome is None or isinstance(outcome, Attempt):
        return outcome
    return _failed(BrokenContractError(attempt, f"it returns {outcome!r:.60}, not Attempt | None"))


def _failed(error: BaseException) -> Attempt:
    reason = f"its driver failed: {message_of(error) or type(error).__name__}"
    return Attempt(present=True, useful=False, reason=reason, error=error)


async def ended(reason: asyncio.Future[str], *threads: Thread) -> str:
    """Wait for the reason with which the threads of a reader end, or for the end of one that gives none."""
    while not reason.done():
        # Checked before the wait: what a thread has reported last is on its way to the loop when it ends.
        alive = all(thread.is_alive() for thread in threads)
        await asyncio.wait({reason}, timeout=LOOK_S)
        if not alive and not reason.done():
            return "its reader has ended without a reason"
    return reason.result()


@contextlib.contextmanager
def sparing_others(link: Link, stream: str, counters: BusCounters) -> Iterator[None]:
    """What goes wrong with one stream is counted and reported once, at no cost to the others of its bus."""
    try:
        yield
    except Exception:
        counters.reader_failures += 1
        if counters.reader_failures == 1:
            logger.exception(
                "%s: samples of stream %r cannot be taken in and are lost",
                link.name,
                stream,
                extra=coded(DRIVER_FAILED),
            )


async def in_thread(
    call: Callable[..., T],
    *arguments: Any,
    undo: Callable[[T], object] | None = None,
    patience_s: float | None = None,
    abort: Callable[[], object] | None = None,
) -> T:
    """Make a blocking call; if cancelled meanwhile, wait for its end all the same and undo what it did.

    A bus that opens after its driver was cancelled must be closed again, or its next owner finds it taken.

    Args:
        call: blocks.
        arguments: of it.
        undo: takes back its result; blocks.
        patience_s: how long to wait for its end when cancelled; None for as long as it takes. One that takes
            longer is left behind: what it did is undone when it ends, and the process may end before it.
        abort: makes it end soon when cancelled; does not block.
    """
    begun = (
        None
        if patience_s is None
        else call_in_thread(partial(call, *arguments), name=getattr(call, "__name__", "call"))
    )
    work = asyncio.ensure_future(
        asyncio.to_thread(call, *arguments) if begun is None else asyncio.wrap_future(begun)
    )
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        if abort is not None:
            abort()
        await asyncio.wait({work}, timeout=patience_s)
        if not work.done():
            work.cancel()
            if undo is not None and begun is not None:
                begun.add_done_callback(partial(_undo_late, undo))
        elif undo is not None and work.exception() is None:
            await asyncio.to_thread(undo, work.result())
        raise
    finally:
        # The exception of a failed call holds this frame: were it held from here, what the call has opened
        # would lie about until the next garbage collection.
        del work, begun


def _undo_late(undo: Callable[[T], object], outcome: Future[T]) -> None:
    if outcome.exception() is None:
        undo(outcome.result())


def words(error: BaseException) -> str:
    """An error as a person should read it."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return message_of(error) or type(error).__name__


Call: TypeAlias = "tuple[Callable[..., object], tuple[Any, ...]]"


class HandOver:
    """Has calls made on the event loop in their order; of all that hand over there, one in each turn of it.

    Batches of many buses that come at once would hold up all else for as long as they take together.

    Args:
        loop: the event loop.
    """

    _lines: ClassVar[WeakKeyDictionary[asyncio.AbstractEventLoop, deque[HandOver]]] = WeakKeyDictionary()
    """By event loop, those who have something to hand over, the next one first."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._calls: deque[Call] = deque()
        self._lock = threading.Lock()
        self._due = False

    def post(self, call: Callable[..., object], *arguments: object) -> None:
        """Have ``call`` made; from any thread.

        Raises:
            RuntimeError: the event loop is closed.
        """
        with self._lock:
            self._calls.append((call, arguments))
            if self._due:
                return
            self._due = True
        self._loop.call_soon_threadsafe(self._line_up)

    def finish(self) -> None:
        """Make at once all calls that wait; on the event loop, when nothing posts any more."""
        while self._calls:
            self._make()

    def _line_up(self) -> None:
        line = self._lines.setdefault(self._loop, deque())
        line.append(self)
        if len(line) == 1:
            self._loop.call_soon(self._next, line)

    def _next(self, line: deque[HandOver]) -> None:
        """Make the next call, and come back for the one after it when all others had their turn."""
        try:
            if self._calls:
                self._make()
        finally:
            line.popleft()
            with self._lock:
                self._due = bool(self._calls)
                if self._due:
                    line.append(self)
            if line:
                self._loop.call_soon(line[0]._next, line)  # noqa: SLF001 - another of this class

    def _make(self) -> None:
        call, arguments = self._calls.popleft()
        call(*arguments)
