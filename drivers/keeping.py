"""What all drivers have in common: a link that is tried again, and blocking calls that end in order."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from functools import partial
from threading import Thread
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from daqsvc.acquisition.supervisor import Backoff
from drivers.base import DeviceAbsentError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from daqsvc.acquisition.supervisor import Link
    from drivers.base import BusPort

T = TypeVar("T")


class Attempt(NamedTuple):
    """How an attempt at a link went.

    Attributes:
        present: whether the device was there.
        useful: whether anything came from it: a link that opens and fails at once is not back.
        reason: why the attempt ended.
    """

    present: bool
    useful: bool
    reason: str


class CannotOpenError(Exception):
    """The link cannot be opened; says why, and what to do about it."""


async def keep_up(
    link: Link,
    port: BusPort,
    attempt: Callable[[], Awaitable[Attempt | None]],
) -> None:
    """Try a link again and again, each time later unless something came over it; until cancelled.

    Args:
        link: its state; `attempt` says when it is up.
        port: what to do if the device is absent at first, and the clock.
        attempt: opens the link and uses it until it is lost; None if there is nothing more to come. It may
            raise `CannotOpenError`, but must not put the link down: that is said here, where it is known
            whether it is tried again.

    Raises:
        DeviceAbsentError: the device is absent at start and the policy is ``"error"``.
    """
    backoff = Backoff()
    first = True
    while (outcome := await _outcome(attempt)) is not None:
        if first and not outcome.present and port.start == "error":
            raise DeviceAbsentError(f"{link.name}: {outcome.reason}")
        if first and not outcome.present and port.start == "ignore":
            link.leave_out(outcome.reason)
            return
        first = False
        link.down(outcome.reason)
        if outcome.useful:
            backoff.reset()
        await port.clock.sleep_ns(backoff.next_ns())


async def _outcome(attempt: Callable[[], Awaitable[Attempt | None]]) -> Attempt | None:
    try:
        return await attempt()
    except CannotOpenError as error:
        return Attempt(present=False, useful=False, reason=f"{error}")


async def in_thread(
    call: Callable[..., T],
    *arguments: Any,
    undo: Callable[[T], object] | None = None,
    patience_s: float | None = None,
) -> T:
    """Make a blocking call; if cancelled meanwhile, wait for its end all the same and undo what it did.

    A bus that opens after its driver was cancelled must be closed again, or its next owner finds it taken.

    Args:
        call: blocks.
        arguments: of it.
        undo: takes back its result; blocks.
        patience_s: how long to wait for its end when cancelled; None for as long as it takes. One that takes
            longer is left behind: what it did is undone when it ends, and the process may end before it.
    """
    begun = None if patience_s is None else _in_thread_of_its_own(call, *arguments)
    work = asyncio.ensure_future(
        asyncio.to_thread(call, *arguments) if begun is None else asyncio.wrap_future(begun)
    )
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
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


def _in_thread_of_its_own(call: Callable[..., T], *arguments: Any) -> Future[T]:
    """Begin a call in a thread that nobody waits for: asyncio's own are waited for when the process ends."""
    outcome: Future[T] = Future()
    outcome.set_running_or_notify_cancel()
    name = f"blocking {getattr(call, '__name__', 'call')}"
    Thread(target=_settle, args=(outcome, call, arguments), name=name, daemon=True).start()
    return outcome


def _settle(outcome: Future[T], call: Callable[..., T], arguments: tuple[Any, ...]) -> None:
    try:
        result = call(*arguments)
    except BaseException as error:  # noqa: BLE001 - whoever waits for the outcome gets it
        outcome.set_exception(error)
        del outcome  # as in `in_thread`
    else:
        outcome.set_result(result)


def _undo_late(undo: Callable[[T], object], outcome: Future[T]) -> None:
    if outcome.exception() is None:
        undo(outcome.result())
