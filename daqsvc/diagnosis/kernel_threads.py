"""The threads that detectors compute in: none is lost for good, and none holds up the end of the process.

A pool of the library does not replace a thread that is gone, and waits at the end for one that hangs.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from daqsvc.threads import ThreadLostError

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


@dataclass(eq=False, slots=True)
class Job(Generic[T]):
    """A call that is to be made.

    Attributes:
        call: what to do.
        outcome: what becomes of it.
        thread: who does it; None while it waits.
    """

    call: Callable[[], T]
    outcome: asyncio.Future[T]
    thread: threading.Thread | None = None


class KernelThreads:
    """Threads that make calls in the order in which they were asked for.

    Args:
        count: threads; so many calls are made at a time.
        failed: told, on the thread, that one was interrupted by an exception of its own; it goes on.
    """

    def __init__(self, count: int, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._changed = threading.Condition()
        self._jobs: list[Job[object]] = []
        self._closing = False
        self._threads: set[threading.Thread] = set()
        self._numbers = 0
        for _ in range(count):
            self._start_thread()

    def submit(self, call: Callable[[], T]) -> Job[T]:
        """Have a call made; on the event loop."""
        for thread in [thread for thread in self._threads if not thread.is_alive()]:
            self._threads.discard(thread)
            self._recover(thread, ThreadLostError(f"thread {thread.name} was lost"))
            self._start_thread()
        job = Job(call, asyncio.get_running_loop().create_future())
        with self._changed:
            self._jobs.append(job)
            self._changed.notify()
        return job

    def replace(self, job: Job[T]) -> bool:
        """Give up the thread that a job hangs in, and start another; whether there was one.

        The job may still come to its end; its thread then ends with it.
        """
        with self._changed:
            if job.thread not in self._threads or job.outcome.done():
                return False
            self._threads.discard(job.thread)
        if not job.thread.is_alive():
            self._settle(job, None, RuntimeError("its thread was lost"))  # type: ignore[arg-type]  # as above
        self._start_thread()
        return True

    def close(self) -> None:
        """Have every thread end when it has made the calls that wait."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def join(self) -> None:
        """Wait for the end of every thread that was not given up; blocks."""
        for thread in list(self._threads):
            thread.join()

    def _start_thread(self) -> None:
        self._numbers += 1
        thread = threading.Thread(target=self._work, name=f"kernel_{self._numbers}", daemon=True)
        self._threads.add(thread)
        thread.start()

    def _work(self) -> None:
        me = threading.current_thread()
        while me in self._threads:
            try:
                job = self._next(me)
                if job is None:
                    return
                self._make(job)
            except BaseException as error:  # noqa: BLE001 - said and counted there
                self._recover(me, error)

    def _next(self, me: threading.Thread) -> Job[object] | None:
        """The next call that waits, which stays on the list until it is made; None at the end."""
        with self._changed:
            while True:
                for job in self._jobs:
                    if job.thread is None:
                        job.thread = me
                        return job
                if self._closing:
                    return None
                self._changed.wait()

    def _make(self, job: Job[object]) -> None:
        try:
            result = job.call()
        except Exception as error:  # noqa: BLE001 - whoever waits gets it
            self._settle(job, None, error)
        else:
            self._settle(job, result, None)

    def _recover(self, me: threading.Thread, error: BaseException) -> None:
        """Something has interrupted the thread: whoever waits for what it was doing hears of it."""
        with self._changed:
            mine = [job for job in self._jobs if job.thread is me]
        for job in mine:
            self._settle(job, None, RuntimeError(f"its thread was interrupted by {error!r}"))
        self._failed(error)

    def _settle(self, job: Job[object], result: object, error: Exception | None) -> None:
        def tell() -> None:
            if not job.outcome.done():
                job.outcome.set_result(result) if error is None else job.outcome.set_exception(error)

        # The loop may be closed, and nobody left who waits.
        with contextlib.suppress(RuntimeError):
            job.outcome.get_loop().call_soon_threadsafe(tell)
        with self._changed:
            if job in self._jobs:
                self._jobs.remove(job)
