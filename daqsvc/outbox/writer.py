"""The thread that writes the journal: group commits, retries, and what to do about a file that fails.

While the disk takes no writes, messages get their numbers all the same and can be read from memory, so that
they reach the broker; the disk gets them later, in the same order.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

from daqsvc.errors.code import coded
from daqsvc.errors.service import DISK_REFUSES, JOURNAL_DAMAGED
from daqsvc.notice import notice
from daqsvc.outbox.files import FileError, is_corrupt
from daqsvc.outbox.messages import Draft, OutboxAwayError, OutboxError, OutboxMessage
from daqsvc.supervision import Progress
from daqsvc.threads import bytes_moved

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from daqsvc.outbox.journal import Journal

    _Post: TypeAlias = Callable[..., None]

_T = TypeVar("_T")

log = logging.getLogger(__name__)

MARK_LINGER_S = 0.05
"""How long a mark may wait for others: nothing depends on it, and each commit costs the disk a sync."""

CROWD_LINGER_S = 0.05
"""How long messages wait for company while they come in a crowd: a commit costs more than 20 of them."""

CROWD_OVER_S, CROWD = 0.1, 20
"""A crowd: this number of messages within this time."""

RETRY_FIRST_S, RETRY_MOST_S = 0.1, 5.0

IDLE_S = 0.5
"""How long the thread sleeps at a time when there is nothing to do."""

COMMIT_AT_MOST = 500
"""Messages, and marks, in one transaction, so that the write-ahead log does not grow with the backlog."""

NAMED = 5
"""Topics that the log names of messages that are lost."""

UNBACKED = (
    "delivery is not backed by the disk until it can; messages wait in memory and go to the broker from "
    "there; they are lost if the process ends before disk or broker has them"
)

READ_FAILURES_MAX = 3
"""Reads in a row that may fail before the file is given up as if it were corrupt."""


@dataclass(slots=True)
class Batch:
    """What one turn of the writer does."""

    drafts: list[tuple[Draft, asyncio.Future[int]]] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)
    reads: list[tuple[Callable[[], Any], asyncio.Future[Any]]] = field(default_factory=list)

    def is_urgent(self) -> bool:
        """Whether somebody waits for it."""
        return bool(self.drafts or self.reads)

    def add(self, other: Batch) -> None:
        """Do the other, too, after this one."""
        self.drafts += other.drafts
        self.sent += other.sent
        self.reads += other.reads


class Crowd:
    """Whether messages come in a crowd, by how many came in the last full spell of `CROWD_OVER_S`."""

    def __init__(self) -> None:
        self._since_s = 0.0
        self._came = 0
        self._before = 0

    def come(self, count: int, now_s: float) -> None:
        """Note how many messages have come by ``now_s``, on a monotonic clock."""
        self._look(now_s)
        self._came += count

    def is_there(self, now_s: float) -> bool:
        """Whether the messages of ``now_s`` are part of a crowd."""
        self._look(now_s)
        return max(self._before, self._came) >= CROWD

    def _look(self, now_s: float) -> None:
        spells = (now_s - self._since_s) // CROWD_OVER_S
        if spells >= 1:
            # Of a longer time than one spell, the last one was empty.
            self._since_s, self._before, self._came = now_s, self._came if spells < 2 else 0, 0


@dataclass(slots=True)
class Failure:
    """What went wrong in one turn of the writer, if anything."""

    write: Exception | None = None
    read: Exception | None = None


class Reports(Protocol):
    """Called on the event loop with what the writer has done."""

    def committed(
        self,
        outcomes: Sequence[tuple[asyncio.Future[int], int | Exception]],
        marked: int,
        last_sequence: int,
    ) -> None:
        """Drafts are on disk under their numbers, or were refused; ``marked`` others are newly sent.

        Messages can be read up to ``last_sequence``.
        """

    def shown(self, last_sequence: int) -> None:
        """The disk takes no messages: up to this number they can be read, from memory."""

    def backed(self) -> None:
        """The disk takes messages again, and has all."""

    def acknowledged(self, from_memory: int, given_up: Sequence[tuple[asyncio.Future[int], int]]) -> None:
        """The broker has so many more that the disk has not; of those, some will never be on the disk."""

    def failed(self, failure: Failure) -> None:
        """A turn failed and will be tried again."""

    def opened(self, unsent: int) -> None:
        """A journal that could not be opened at first is open; it has so many unsent messages."""

    def replaced(self, unsent: int) -> None:
        """A corrupt file was set aside, and a new one begun, with this number of unsent messages."""

    def abandoned(
        self, lost: Sequence[asyncio.Future[int]], accepted: Sequence[asyncio.Future[int]], error: OutboxError
    ) -> None:
        """Messages that will not reach the disk any more: ``lost``, or ``accepted`` by the broker."""

    def stopped(self, reason: str) -> None:
        """The writer has ended through a mistake in this program."""


class JournalWriter:
    """Does all that is done with one journal, in the order in which it was asked for.

    Args:
        journal: the file; nobody else may use it.
        reports: called with what the writer has done.
        make_way: called on the thread before the journal is opened, with its directory in our possession.
    """

    def __init__(self, journal: Journal, reports: Reports, make_way: Callable[[], None]) -> None:
        self._journal = journal
        self._reports = reports
        self._make_way = make_way
        self._work: queue.SimpleQueue[Batch] = queue.SimpleQueue()
        self._marks: deque[int] = deque()
        self._expects_marks = False
        self._closing = threading.Event()
        self._crowd = Crowd()
        self._waiting: dict[int, asyncio.Future[int]] = {}
        """By number, who waits for a message to be on the disk."""
        self._thread: threading.Thread | None = None
        self._turns = 0

    def start(self) -> tuple[asyncio.Future[int | None], asyncio.Future[None]]:
        """Start the thread.

        Returns:
            What becomes the number of unsent messages, None if the disk cannot be used for now, or an
            `OutboxError`; and what is done at the end.
        """
        loop = asyncio.get_running_loop()
        opened: asyncio.Future[int | None] = loop.create_future()
        ended: asyncio.Future[None] = loop.create_future()
        self._thread = threading.Thread(
            target=self._run, args=(loop, opened, ended), name="outbox-writer", daemon=True
        )
        self._thread.start()
        return opened, ended

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def progress(self) -> Progress:
        """How far the thread has come; it comes round several times a second, also while the disk fails."""
        if self._thread is None or not self._thread.is_alive():
            return Progress(None)
        # Saving what can be read of a large file is one turn, however long it takes.
        return Progress((self._turns, bytes_moved(self._thread)), self._thread)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end of the thread, at most so long; whether it has ended. Blocks; from any thread."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return not self.is_alive

    @property
    def is_closing(self) -> bool:
        """Whether `close` was called."""
        return self._closing.is_set()

    def put(self, batch: Batch) -> None:
        """Have something done."""
        self._work.put(batch)

    def mark(self, sequences: Iterable[int]) -> None:
        """Mark messages as sent, together with the next work or within `MARK_LINGER_S`; from one thread."""
        self._marks.extend(sequences)
        if not self._expects_marks:  # else the thread knows already: to wake it costs more than a mark
            self._expects_marks = True
            self._work.put(Batch())

    def close(self) -> None:
        """Do what waits, once, and end."""
        self._closing.set()
        self._work.put(Batch())

    # On the thread.

    def _run(
        self, loop: asyncio.AbstractEventLoop, opened: asyncio.Future[int | None], ended: asyncio.Future[None]
    ) -> None:
        def post(function: Callable[..., object], *args: object) -> None:
            # On a loop that is closed already nothing waits for the answer.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(function, *args)

        batch = Batch()
        try:
            try:
                unsent = self._begin(post)
            except (OutboxError, *FileError) as error:
                self._journal.close()  # first: whoever hears of it may try again at once
                post(fail, opened, error)
                return
            post(succeed, opened, unsent)
            self._serve(batch, post)
        except BaseException as error:
            # A mistake in this program. What waits must get it as an error: it must not wait in vain.
            post(self._reports.stopped, f"has stopped: {error!r}")
            self._gather(batch, wait=False)
            self._abandon(batch, error, post)
            raise
        finally:
            self._journal.close()
            post(self._answer_the_rest, post)
            post(succeed, ended, None)

    def _answer_the_rest(self, post: _Post) -> None:
        """Answer what came while the thread ended; on the event loop, which lets nothing more come then."""
        batch = Batch()
        self._gather(batch, wait=False)
        if batch.is_urgent():
            self._abandon(batch, OutboxError("its thread has ended"), post)

    def _begin(self, post: _Post) -> int | None:
        """Open the journal; the number of unsent messages, or None if it cannot be opened for now.

        Raises:
            OutboxError: it cannot be opened, and that will not pass by itself.
        """
        while True:
            try:
                self._journal.hold()
                self._make_way()
                self._journal.open()
                return self._journal.unsent()
            except OutboxAwayError as error:
                if not self._recover(_cause(error), post, give_up=False):
                    return None

    def _open(self, post: _Post) -> None:
        """Open the journal as soon as that can be done."""
        if self._journal.is_ready:
            return
        self._journal.open()
        post(self._reports.opened, self._journal.unsent())

    def _serve(self, batch: Batch, post: _Post) -> None:
        retry_s = RETRY_FIRST_S
        reported: Exception | None = None
        failed_reads = 0
        while True:
            self._gather(batch, wait=reported is None and self._journal.is_ready)
            failure = self._perform(batch, post)
            error = failure.write or failure.read
            if error is None:
                if self._journal.shows:
                    self._journal.hide()
                    post(self._reports.backed)
                if reported is not None:
                    reported = None
                    notice(log, "outbox %s can be used again", self._journal.path)
                retry_s, failed_reads = RETRY_FIRST_S, 0
                if self._closing.is_set() and self._work.empty():
                    return
                continue
            post(self._reports.failed, failure)
            if self._closing.is_set():
                self._gather(batch, wait=False)  # what came during the turn that failed
                self._show(batch, post)  # what the broker has is not lost
                self._abandon(batch, error, post)
                return
            has_failed_to_read = failure.read is not None and self._journal.is_ready
            failed_reads = failed_reads + 1 if has_failed_to_read else 0
            if reported is None:
                reported = error
                log.error(
                    "outbox %s cannot be %s: %s; %s",
                    self._journal.path,
                    ("written" if self._journal.is_ready else "opened") if failure.write else "read",
                    error,
                    UNBACKED if failure.write else "messages wait until it can",
                    extra=coded(DISK_REFUSES),
                )
            if not self._recover(error, post, give_up=failed_reads >= READ_FAILURES_MAX):
                if failure.write:
                    self._show(batch, post)
                self._wait_for_disk(batch, post, retry_s)
                retry_s = min(2 * retry_s, RETRY_MOST_S)

    def _gather(self, batch: Batch, *, wait: bool) -> None:
        """Add what has arrived; marks alone wait for company for a while."""
        self._turns += 1
        if wait:
            batch.add(self._next())
            if self._crowd.is_there(time.monotonic()) and not batch.reads:
                self._closing.wait(CROWD_LINGER_S)
        until = time.monotonic() + MARK_LINGER_S
        while True:
            linger_s = until - time.monotonic()
            patient = wait and not batch.is_urgent() and not self._closing.is_set() and linger_s > 0
            try:
                batch.add(self._work.get(timeout=linger_s) if patient else self._work.get_nowait())
            except queue.Empty:
                break
        self._expects_marks = False  # first: what comes from here on wakes the thread again
        while self._marks:
            batch.sent.append(self._marks.popleft())

    def _next(self) -> Batch:
        # Not one long wait: whatever interrupts a thread does so between two steps, and would take with it
        # what has just been got.
        while True:
            self._turns += 1
            with contextlib.suppress(queue.Empty):
                return self._work.get(timeout=IDLE_S)

    def _show(self, batch: Batch, post: _Post) -> None:
        """Have messages go out from memory."""
        self._journal.show()
        try:
            self._take(batch, post)
        except (OutboxError, *FileError) as error:
            log.debug("outbox %s has no numbers: %s", self._journal.path, error)
        post(self._reports.shown, self._journal.newest)

    def _wait_for_disk(self, batch: Batch, post: _Post, seconds: float) -> None:
        """Wait until the disk is tried again; meanwhile send new messages from memory, where that can be."""
        until = time.monotonic() + seconds
        while not self._closing.is_set() and (left_s := until - time.monotonic()) > 0:
            self._turns += 1
            try:
                batch.add(self._work.get(timeout=min(left_s, IDLE_S)))
            except queue.Empty:
                continue
            self._gather(batch, wait=False)
            if self._journal.shows:
                self._show(batch, post)
                self._read(batch, post)

    def _perform(self, batch: Batch, post: _Post) -> Failure:
        """Commit, then read, even if the former failed. What is done is taken out of the batch."""
        failure = Failure()
        try:
            self._open(post)
            self._take(batch, post)
            while self._journal.has_unwritten:
                self._commit(post)
        except (OutboxError, *FileError) as error:
            failure.write = _cause(error)
        failure.read = self._read(batch, post)
        return failure

    def _take(self, batch: Batch, post: _Post) -> None:
        """Give what has come its numbers, and note what was acknowledged."""
        if batch.drafts:
            outcomes = self._journal.number([draft for draft, _ in batch.drafts])
            drafts, batch.drafts = batch.drafts, []
            refused: list[tuple[asyncio.Future[int], int | Exception]] = []
            for (_, done), outcome in zip(drafts, outcomes, strict=True):
                if isinstance(outcome, OutboxMessage):
                    self._waiting[outcome.sequence] = done
                else:
                    refused.append((done, outcome))
            self._crowd.come(len(drafts), time.monotonic())
            if refused:
                post(self._reports.committed, refused, 0, self._journal.newest)
        sent, batch.sent = batch.sent, []
        from_memory, given_up = self._journal.acknowledge(sent)
        if from_memory:
            never = [(self._waiting.pop(number), number) for number in given_up]
            post(self._reports.acknowledged, from_memory, never)

    def _read(self, batch: Batch, post: _Post) -> Exception | None:
        try:
            while batch.reads:
                query, answer = batch.reads[0]
                post(succeed, answer, query())
                batch.reads.pop(0)
        except (OutboxError, *FileError) as error:
            return _cause(error)
        return None

    def _commit(self, post: _Post) -> None:
        numbers, marked = self._journal.write(COMMIT_AT_MOST)
        settled = [(self._waiting.pop(number), number) for number in numbers]
        post(self._reports.committed, settled, marked, self._journal.newest)

    def _recover(self, error: Exception, post: _Post, *, give_up: bool) -> bool:
        """Do something about a failure; whether it is worth trying again at once.

        A corrupt file is set aside, and so is one that cannot be read time and again. On a full disk, what
        the broker has makes room.
        """
        try:
            if self._journal.is_ready and (give_up or is_corrupt(error)):
                self._journal.quarantine(error)
                post(self._reports.replaced, self._journal.unsent())
                return True
            if self._journal.is_short_of_room(error):
                return self._journal.make_room()
        except FileError as again:
            if not self._journal.is_short_of_room(again):
                log.error(  # noqa: TRY400 - the message is enough
                    "outbox %s cannot be recovered: %s",
                    self._journal.path,
                    again,
                    extra=coded(JOURNAL_DAMAGED),
                )
                return False
            try:
                return self._journal.make_room()
            except FileError:
                return False  # there is none: it waits
        return False

    def _abandon(self, batch: Batch, error: BaseException, post: _Post) -> None:
        failure = OutboxError(
            f"outbox {self._journal.path} was closed while it could not be written: {error}"
        )
        waiting = self._journal.waiting
        lost = [self._waiting.pop(m.sequence) for m in waiting if m.sequence in self._waiting]
        lost += [done for _, done in batch.drafts]
        accepted = list(self._waiting.values())
        self._waiting.clear()
        post(self._reports.abandoned, lost, accepted, failure)
        for _, answer in batch.reads:
            post(fail, answer, failure)
        topics = Counter(
            [*(message.topic for message in waiting), *(draft.topic for draft, _ in batch.drafts)]
        )
        if lost:
            log.error(
                "outbox %s lost %d messages, which neither the disk nor the broker has: %s; they were on %s",
                self._journal.path,
                len(lost),
                error,
                _named(topics),
                extra=coded(JOURNAL_DAMAGED),
            )
        if accepted:
            log.error(
                "outbox %s will never have %d messages that the broker has: %s",
                self._journal.path,
                len(accepted),
                error,
                extra=coded(JOURNAL_DAMAGED),
            )


def _named(topics: Counter[str]) -> str:
    """Topics, those with the most messages first, and how many each has."""
    named = [f"{topic} ({count})" for topic, count in topics.most_common(NAMED)]
    rest = len(topics) - len(named)
    return ", ".join(named) + (f" and {rest} others" if rest else "")


def _cause(error: Exception) -> Exception:
    """What the system or SQLite reports, rather than what is made of it for a person."""
    return error.__cause__ if isinstance(error.__cause__, Exception) else error


def succeed(future: asyncio.Future[_T], result: _T) -> None:
    """Answer whoever still waits."""
    if not future.done():
        future.set_result(result)


def fail(future: asyncio.Future[Any], error: Exception) -> None:
    """Answer whoever still waits why there is no result."""
    if not future.done():
        future.set_exception(error)
