"""Blocking calls in their own threads, which need not be waited for.

The threads of a common pool are waited for when the process ends, so one call that hangs, such as a read of a
disk that is gone, would keep the process from ending. And a pool that has lost a thread does not notice.
"""

from __future__ import annotations

import sys
import traceback
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, ParamSpec, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

P = ParamSpec("P")
T = TypeVar("T")


class ThreadLostError(Exception):
    """A thread has ended before it had done what it was to do."""


class CallThreads(ThreadPoolExecutor):
    """An executor for asyncio's `to_thread` that gives each call its own thread.

    The end of the process waits for none of them.
    """

    def __init__(self) -> None:
        super().__init__(1)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """See `concurrent.futures.Executor.submit`."""
        return call_in_thread(lambda: fn(*args, **kwargs), name=getattr(fn, "__name__", "call"))


def call_in_thread(call: Callable[[], T], *, name: str) -> Future[T]:
    """Begin a call in a thread that is not waited for.

    Args:
        call: blocks.
        name: of the call, for the name of the thread.

    Returns:
        What becomes of it; it is settled however the thread ends.
    """
    outcome: Future[T] = Future()
    outcome.set_running_or_notify_cancel()
    Thread(target=_settle, args=(outcome, call), name=f"blocking {name}", daemon=True).start()
    return outcome


def where_is(ident: int | None) -> str:
    """Where in the program a thread is, innermost first: ``"read (x.py:12), called from drain (y.py:3)"``."""
    frame = sys._current_frames().get(ident or 0)  # noqa: SLF001 - there is no other way to look
    steps = [f"{s.name} ({Path(s.filename).name}:{s.lineno})" for s in traceback.extract_stack(frame)[-3:]]
    return ", called from ".join(reversed(steps)) if frame is not None else "a thread that is gone"


def kept_waiting_s(thread: Thread) -> float:
    """How long a thread has waited for a processor so far; 0 where the kernel does not count that."""
    try:
        _, waited_ns, _ = Path(f"/proc/self/task/{thread.native_id}/schedstat").read_text().split()
    except (OSError, ValueError):
        return 0.0
    return int(waited_ns) / 1e9


def bytes_moved(thread: Thread) -> int:
    """What a thread has read and written so far; 0 where the kernel does not count that."""
    try:
        lines = Path(f"/proc/self/task/{thread.native_id}/io").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith(("rchar", "wchar")))


def _settle(outcome: Future[T], call: Callable[[], T]) -> None:
    try:
        try:
            result = call()
        except Exception as error:  # noqa: BLE001 - whoever waits for the outcome gets it
            outcome.set_exception(error)
        else:
            outcome.set_result(result)
    finally:
        if not outcome.done():
            # What ends a thread, such as SystemExit, must not end the task that waits for it.
            outcome.set_exception(ThreadLostError("the thread of a blocking call has ended before the call"))
        # A failed call's exception holds this frame: were the outcome held from here, what the call has
        # opened would lie about until the next garbage collection.
        del outcome
