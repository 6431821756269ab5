"""The pipeline: one task per detector takes windows from a ring and has them processed off the loop.

None of the threads that detectors compute in is lost for good, none holds up the end of the process, and one
that a detector keeps busy is missed by no other. A pool of the library does not replace a thread that is
gone, and waits at the end for one that hangs.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeVar

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.ring import RingClosed, RingReader
from daqsvc.acquisition.standing import StreamState, wording_of
from daqsvc.diagnosis.record import silence_reason
from daqsvc.diagnosis.statements import asked, silence_statements, window_statements
from daqsvc.dsp.quality.missing import Patience
from daqsvc.errors.code import coded
from daqsvc.errors.detectors import NO_DETECTOR
from daqsvc.errors.service import TOO_SLOW
from daqsvc.settings.failures import BrokenContractError, error_text
from daqsvc.supervision import Progress, Supervisor, over
from daqsvc.threads import ThreadLostError, call_in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.ring import SampleRing
    from daqsvc.acquisition.standing import Tell
    from daqsvc.diagnosis.detector import Detector, Window
    from daqsvc.diagnosis.record import Diagnosis


T = TypeVar("T")


@dataclass(eq=False, slots=True)
class Job(Generic[T]):
    """A call that is to be made.

    Attributes:
        call: what to do.
        outcome: what becomes of it.
        thread: who does it; None while it waits.
        apart: whether the thread does nothing else any more.
        given_up: whether the thread is not waited for any more.
    """

    call: Callable[[], T]
    outcome: asyncio.Future[T]
    thread: threading.Thread | None = None
    apart: bool = False
    given_up: bool = False


class KernelThreads:
    """Threads that make calls in the order in which they were asked for; for one pipeline or for several.

    They are started when there is something to do, and end with the last one who uses them. Of those that
    wait the last one to have worked is asked: its processor knows the kernels best.

    Args:
        count: so many calls are made at a time, besides those that are set apart.
        failed: called, on the thread, when one was interrupted by its own exception; it goes on.
    """

    def __init__(self, count: int, failed: Callable[[BaseException], None]) -> None:
        self._count = count
        self._failed = failed
        self._lock = threading.RLock()
        self._idle: list[threading.Condition] = []
        self._jobs: list[Job[object]] = []
        self._users = 0
        self._threads: set[threading.Thread] = set()
        self._apart: set[threading.Thread] = set()
        self._numbers = 0

    def enter(self) -> None:
        """Begin to use them."""
        self._users += 1

    async def leave(self, jobs: Iterable[Job[T]]) -> None:
        """Use them no more; the last one to leave has them end.

        Args:
            jobs: what is left to do; waited for, as are the threads that end, but for what was given up.
        """
        self._users -= 1
        if not self._users:
            with self._lock:
                for idle in self._idle:
                    idle.notify()
        if left := {job.outcome for job in jobs if not job.given_up}:
            await asyncio.wait(left)
        if not self._users:
            await asyncio.to_thread(self._join)

    def submit(self, call: Callable[[], T]) -> Job[T]:
        """Have a call made; on the event loop, while in use."""
        for thread in [thread for thread in self._threads if not thread.is_alive()]:
            self._threads.discard(thread)
            self._recover(thread, ThreadLostError(f"thread {thread.name} was lost"))
        job = Job(call, asyncio.get_running_loop().create_future())
        with self._lock:
            self._jobs.append(job)
            if self._idle:
                self._idle.pop().notify()
            elif len(self._threads) < self._count:
                self._start_thread()
        return job

    def set_apart(self, job: Job[T]) -> None:
        """Have another thread go on with the calls that wait, if the job was begun: it takes long.

        The job's thread ends with it.
        """
        with self._lock:
            if job not in self._jobs or job.thread not in self._threads:
                return
            self._threads.discard(job.thread)
            self._apart.add(job.thread)
            job.apart = True
            if any(one.thread is None for one in self._jobs):
                self._start_thread()

    def give_up(self, job: Job[T]) -> None:
        """Wait no longer for the end of the thread of a job that was set apart."""
        job.given_up = True
        if job.thread is None:
            return
        self._apart.discard(job.thread)
        if not job.thread.is_alive():
            self._settle(job, None, RuntimeError("its thread was lost"))  # type: ignore[arg-type]  # as above

    def _join(self) -> None:
        """Wait for the end of every thread that was not given up; blocks."""
        for thread in [*self._threads, *self._apart]:
            thread.join()

    def _start_thread(self) -> None:
        self._numbers += 1
        thread = threading.Thread(target=self._work, name=f"kernel_{self._numbers}", daemon=True)
        self._threads.add(thread)
        thread.start()

    def _work(self) -> None:
        me = threading.current_thread()
        with contextlib.suppress(OSError, AttributeError):  # Linux alone knows the priority of a thread
            os.setpriority(
                os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + NICE
            )
        while me in self._threads:
            try:
                job = self._next(me)
                if job is not None:
                    self._make(job)
            except BaseException as error:  # noqa: BLE001 - reported and counted there
                self._recover(me, error)
        self._apart.discard(me)

    def _next(self, me: threading.Thread) -> Job[object] | None:
        """The next call that waits, which stays on the list until it is made; None at the end."""
        with self._lock:
            while True:
                for job in self._jobs:
                    if job.thread is None:
                        job.thread = me
                        return job
                if not self._users:
                    self._threads.discard(me)
                    return None
                idle = threading.Condition(self._lock)
                try:
                    self._idle.append(idle)
                    idle.wait()
                finally:
                    if idle in self._idle:
                        self._idle.remove(idle)

    def _make(self, job: Job[object]) -> None:
        try:
            result = job.call()
        except Exception as error:  # noqa: BLE001 - whoever waits gets it
            self._settle(job, None, error)
        else:
            self._settle(job, result, None)

    def _recover(self, me: threading.Thread, error: BaseException) -> None:
        """Something has interrupted the thread: whoever waits for what it was doing hears of it."""
        with self._lock:
            mine = [job for job in self._jobs if job.thread is me]
        for job in mine:
            self._settle(job, None, RuntimeError(f"its thread was interrupted by {error!r}"))
        self._failed(error)

    def _settle(self, job: Job[object], result: object, error: Exception | None) -> None:
        def tell() -> None:
            if not job.outcome.done():
                job.outcome.set_result(result) if error is None else job.outcome.set_exception(error)

        # The loop may be closed, and nothing waits any more.
        with contextlib.suppress(RuntimeError):
            job.outcome.get_loop().call_soon_threadsafe(tell)
        with self._lock:
            if job in self._jobs:
                self._jobs.remove(job)


logger = logging.getLogger(__name__)

MOST_BLOCKS = 64
"""Blocks in one window at most: a detector that is behind catches up in long strides."""

LOOK_NS = NS_PER_S // 2
_LONGEST_PREPARATION_NS = 300 * NS_PER_S
"""A driver that is not ready by then hangs, and the silence of its streams counts."""

_SETTLED_NS = 10 * NS_PER_S
"""A silence is reported once more after something else has been its reason for so long.

For as long as the stream may be silent, where that is longer: its next value comes some time after its bus.
"""

MOST_HELD = 4096
"""Statements of a stream that wait for its rate to be known, at most; the oldest are dropped."""

LONG_S = 0.5
"""A window that takes longer to process has its thread to itself, and the others go on with another."""

HANG_S = 30.0
"""One that takes so much longer hangs; its detector is left alone with it."""

NICE = 10
"""By how much the priority of what computes is lower than that of the event loop, which has to be on time."""

THREADS = 2
"""Windows that are processed at a time, besides those that take long: of one machine or of several."""


@dataclass(slots=True)
class DetectorCounters:
    """What a detector has done; every figure only grows.

    Attributes:
        windows: windows processed.
        samples: samples in them.
        samples_skipped: samples overwritten before it came to them, exactly; what never arrived is none.
        samples_withheld: samples that it was not given, since nothing could be judged by them.
        failures: windows in which it raised, against its contract.
        busy_ns: time its kernels took, on the host's clock.
    """

    windows: int = 0
    samples: int = 0
    samples_skipped: int = 0
    samples_withheld: int = 0
    failures: int = 0
    busy_ns: int = 0


@dataclass(slots=True)
class _Cause:
    """Why nothing comes of a stream, as it was reported.

    Attributes:
        why: in a clause; empty if it is not known.
        last_ns: when that was last so.
    """

    why: str
    last_ns: int

    def is_another(self, why: str, now_ns: int, patience_ns: int) -> bool:
        """Whether something else is the reason, and has been for long enough to report it.

        A unit that is asked now and then is silent by turns, and set aside because it is.
        """
        was, now = wording_of(self.why), wording_of(why)
        if was == now or (was and now and (was in now or now in was)):
            self.last_ns = now_ns
        return now_ns - self.last_ns >= max(_SETTLED_NS, patience_ns)


class Pipeline:
    """Runs detectors over rings until the rings are closed; the failure of one is no matter to another.

    Args:
        rings: by stream name.
        detectors: each names its stream.
        report: called on the event loop with each diagnosis, per detector in order.
        clock: shows how long a stream has been silent.
        kernels: threads that detectors compute in; None for some of its own.
        settling_ns: by stream, how long its first sample may be in coming without the stream being silent.
        patience: by stream, how long it may be silent; whatever is not named is fast.
        supervisor: keeps the detectors' tasks going; None for one of its own.
        fall_silent: called with the name and the standing of a stream in doubt of which nothing comes any
            more; who reports the state of streams passes it on. None: it is passed on at once.
        why_over: why nothing more can come of a stream, in a clause; empty if something may.
        why_silent: what the bus of a stream states of why nothing comes, in a clause; empty if nothing.
        bus_quiet: that nothing else comes over the bus of a stream, in a clause; empty if something may.
        is_prepared_for: whether the driver of a stream still makes itself ready to read it.
        make_reader: makes what hands the samples of a ring to a detector.
        on_read: called on the event loop with a detector's name and each window that is read for it.
        on_processed: called, on the thread that computes, with a detector and each window it has processed.
        listens: whether to find out that a stream is silent; else whoever knows calls `fell_silent`.
    """

    def __init__(
        self,
        rings: Mapping[str, SampleRing],
        detectors: Sequence[Detector],
        report: Callable[[Diagnosis], None],
        clock: Clock,
        kernels: KernelThreads | None = None,
        settling_ns: Mapping[str, int] | None = None,
        patience: Mapping[str, Patience] | None = None,
        supervisor: Supervisor | None = None,
        fall_silent: Tell | None = None,
        why_over: Callable[[str], str] = lambda _stream: "",
        why_silent: Callable[[str], str] = lambda _stream: "",
        bus_quiet: Callable[[str], str] = lambda _stream: "",
        is_prepared_for: Callable[[str], bool] = lambda _stream: False,
        make_reader: Callable[[SampleRing], RingReader] = RingReader,
        on_read: Callable[[str, Window], None] = lambda _detector, _window: None,
        on_processed: Callable[[Detector, Window], None] = lambda _detector, _window: None,
        *,
        listens: bool = True,
    ) -> None:
        self._listens = listens
        self._on_read = on_read
        self._on_processed = on_processed
        self.counters = {detector.name: DetectorCounters() for detector in detectors}
        self.detectors = tuple(detectors)
        self.readers = {d.name: make_reader(rings[d.stream]) for d in detectors}
        self._rings = rings
        self._settling_ns = settling_ns or {}
        self._patience = {name: Patience() for name in rings} | dict(patience or {})
        self._silent_until_ns = dict.fromkeys(rings, -1)
        self._standings = dict.fromkeys(rings, StreamState())
        self._fall_silent = fall_silent or self.stand
        self._why_over = why_over
        self._why_silent = why_silent
        self._bus_quiet = bus_quiet
        self._is_prepared_for = is_prepared_for
        self._doubts_reported = dict.fromkeys(rings, 0)
        self._changes = dict.fromkeys(rings, 0)
        self._held: dict[str, deque[Diagnosis]] = {name: deque(maxlen=MOST_HELD) for name in rings}
        self._seen_changes = dict.fromkeys(self.counters, 0)
        self._report = report
        self._clock = clock
        self._supervisor = supervisor or Supervisor()
        self._kernels = kernels or KernelThreads(THREADS, kernel_failed(self._supervisor))
        self._names: dict[str, frozenset[str]] = {}
        """By detector, the names that its statements may have."""
        self._under_way: dict[str, Job[Sequence[Diagnosis]]] = {}
        """By detector, the window that is being processed: it outlives the task that has begun it."""

    @property
    def behind_samples(self) -> int:
        """Samples that the slowest detector has not read yet."""
        return max((reader.behind for reader in self.readers.values()), default=0)

    @property
    def is_judging(self) -> bool:
        """Whether a window is being processed of which nothing has been stated yet."""
        return bool(self._under_way)

    def progress(self) -> dict[str, Progress]:
        """How far each detector has come with the samples that wait for it."""
        parts: dict[str, Progress] = {}
        for detector in self.detectors:
            reader, job = self.readers[detector.name], self._under_way.get(detector.name)
            waits = job is not None or reader.behind >= detector.block
            step = (self.counters[detector.name].windows, reader.position) if waits else None
            parts[_part(detector)] = Progress(step, None if job is None else job.thread)
        return parts

    def stand(self, stream: str, standing: StreamState) -> None:
        """Take in how a stream stands; call on the event loop.

        While nothing can be judged by it its detectors get no samples, and hold their last statements.
        What is stated before its rate is known waits for that.
        """
        before, self._standings[stream] = self._standings[stream], standing
        self._doubts_reported[stream] += bool(standing.doubt) and not standing.silent
        if standing.doubt != before.doubt:
            self._changes[stream] += 1
            self._held[stream].clear()
            if standing.doubt:
                self._say_doubt(stream, standing.doubt)
        elif standing.proven:
            self._let_go(stream)

    def fell_silent(self, stream: str, t_ns: int) -> None:
        """Take in that a stream is silent; call on the event loop.

        What its detectors find in samples from before that is not reported any more. A stream in doubt stays
        as it stands.

        Args:
            stream: its name.
            t_ns: when that was noticed.
        """
        if not self._standings[stream].doubt:
            self._let_go(stream)
            self._silent_until_ns[stream] = t_ns

    def _say_doubt(self, stream: str, doubt: str) -> None:
        now_ns = self._clock.monotonic_ns()
        for detector in self.detectors:
            if detector.stream == stream:
                with self._supervisor.sparing_others(
                    _part(detector), "the others report that nothing is judged"
                ):
                    for diagnosis in silence_statements(detector, 0.0, now_ns):
                        self._report(replace(diagnosis, quality="missing", reason=doubt))

    def _let_go(self, stream: str) -> None:
        """Report what has waited for the rate of its stream."""
        held = self._held[stream]
        while held:
            diagnosis = held.popleft()
            with self._supervisor.sparing_others(
                f"detector {diagnosis.detector}", "one statement of it is lost"
            ):
                self._report(diagnosis)

    async def warm(self) -> None:
        """Compile every kernel before the first sample comes.

        May be cancelled at any time: compiling cannot be interrupted, but the process need not wait. A
        detector that fails here will compile when its samples come.
        """
        warming = call_in_thread(self._compile_all, name="kernel warming")
        with self._supervisor.sparing_others("kernel warming", "kernels compile when samples come"):
            await asyncio.wrap_future(warming)

    def _compile_all(self) -> None:
        for detector in self.detectors:
            with self._supervisor.sparing_others(_part(detector), "it compiles when samples come"):
                asked(detector.warm)

    async def run(self) -> None:
        """Process until every ring is closed and every whole block in it is processed.

        Cancelled, it can be called again, and goes on where it was.
        """
        self._kernels.enter()
        keep = self._supervisor.keep
        listening = [keep("silence", self._listen_for_silence)] if self._listens else []
        following = [
            keep(_part(d), partial(self._follow, d), may_end=partial(_is_closed, self._rings[d.stream]))
            for d in self.detectors
        ]
        try:
            await over(following)
            while not all(ring.is_closed for ring in self._rings.values()):  # some of them are not followed
                await self._clock.sleep_ns(LOOK_NS)
        finally:
            for part in (*listening, *following):
                part.stop()
            # A cancelled task may have left a kernel running; nothing is left behind, nor the loop held up.
            await asyncio.shield(self._kernels.leave(self._under_way.values()))
            await over([*listening, *following])

    async def _listen_for_silence(self) -> None:
        """Have detectors state, once, that their stream has fallen silent: no window comes that shows it.

        It is stated once more if the bus reports only then why nothing comes, and when that is no longer so
        or has become another reason, and has been for some seconds.

        Of a stream in doubt samples may not come as far as the ring; the doubt states that frames come.

        A process that was suspended has not listened: what came meanwhile still waits to be read.
        """
        heard = {name: (ring.end_index, self._doubts_reported[name]) for name, ring in self._rings.items()}
        begun_ns = looked_ns = self._clock.monotonic_ns()
        since_ns = {name: looked_ns + self._settling_ns.get(name, 0) for name in self._rings}
        silent: set[str] = set()
        unexplained: set[str] = set()
        causes: dict[str, _Cause] = {}
        while True:
            await self._clock.sleep_ns(LOOK_NS)
            now_ns = self._clock.monotonic_ns()
            late_ns, looked_ns = now_ns - looked_ns - LOOK_NS, now_ns
            if late_ns > LOOK_NS:
                since_ns = {name: heard_ns + late_ns for name, heard_ns in since_ns.items()}
            for name, ring in self._rings.items():
                if now_ns - begun_ns < _LONGEST_PREPARATION_NS and self._is_prepared_for(name):
                    since_ns[name] = now_ns + self._settling_ns.get(name, 0)
                has_doubt = bool(self._standings[name].doubt)
                come = (heard[name][0] if has_doubt else ring.end_index, self._doubts_reported[name])
                if come != heard[name]:
                    if name not in silent and not has_doubt:
                        self._patience[name].heard_after(now_ns - since_ns[name])
                    heard[name], since_ns[name] = come, now_ns
                    silent.discard(name)
                    unexplained.discard(name)
                elif name not in silent and now_ns - since_ns[name] >= self._patience[name].ns:
                    silent.add(name)
                    why = self._say_nothing_comes(name, now_ns - since_ns[name], now_ns)
                    unexplained |= set() if why else {name}
                    causes[name] = _Cause(why, now_ns)
                elif name in silent:
                    why = self._why_over(name) or self._why_silent(name)
                    other = causes[name].is_another(why, now_ns, self._patience[name].ns)
                    if (name in unexplained and why) or other:
                        unexplained.discard(name)
                        self._say_nothing_comes(name, now_ns - since_ns[name], now_ns)
                        causes[name] = _Cause(why, now_ns)

    def _say_nothing_comes(self, stream: str, silence_ns: int, now_ns: int) -> str:
        """Have the detectors of a stream state that nothing comes; returns why, if that is known."""
        silence_s = silence_ns / NS_PER_S
        standing = self._standings[stream]
        over, why, beside = self._why_over(stream), self._why_silent(stream), self._bus_quiet(stream)
        reason = (
            f"no more samples of stream {stream!r}: {over}"
            if over
            else silence_reason(stream, silence_s, why, beside)
        )
        if standing.doubt:
            # What the stream was doubted for is no longer what is wrong.
            self._fall_silent(stream, StreamState(reason, standing.proven, silent=True))
            return over or why
        self.fell_silent(stream, now_ns)
        if not any(detector.stream == stream for detector in self.detectors):
            logger.warning("%s; no detector reads them", reason, extra=coded(NO_DETECTOR))
        for detector in self.detectors:
            if detector.stream == stream:
                with self._supervisor.sparing_others(
                    _part(detector), "the other detectors report that nothing comes"
                ):
                    for diagnosis in silence_statements(detector, silence_s, now_ns):
                        self._report(
                            replace(diagnosis, reason=reason) if over or why or beside else diagnosis
                        )
        return over or why

    async def _follow(self, detector: Detector) -> None:
        while True:
            if detector.name not in self._under_way:
                window = await self._next_window(detector)
                if window is None:
                    self._let_go(detector.stream)
                    return
                work = partial(self._process, detector, window)
                self._under_way[detector.name] = self._kernels.submit(work)
            job = self._under_way[detector.name]
            await self._until_made(detector, job)
            del self._under_way[detector.name]
            stream, diagnoses = detector.stream, job.outcome.result()
            if self._changes[stream] != self._seen_changes[detector.name]:
                continue  # its samples may not have been what they seemed
            # What lies before a silence that was reported is history: it must not be used after it.
            self._held[stream] += (one for one in diagnoses if one.t_ns > self._silent_until_ns[stream])
            if self._standings[stream].proven:
                self._let_go(stream)

    async def _next_window(self, detector: Detector) -> Window | None:
        """The next samples for a detector; None if no more will come."""
        reader, counters = self.readers[detector.name], self.counters[detector.name]
        withheld, broken = 0, False
        while True:
            try:
                skipped_before = reader.samples_skipped
                window = await reader.read(detector.block, MOST_BLOCKS)
            except RingClosed:
                return None
            self._on_read(detector.name, window)
            stream, changes = detector.stream, self._changes[detector.stream]
            if not self._standings[stream].doubt and changes == self._seen_changes[detector.name]:
                break
            # What came before a doubt was over is not to be judged by, either.
            self._seen_changes[detector.name] = changes
            counters.samples_withheld += len(window.samples)
            withheld += window.skipped + len(window.samples)
            broken = broken or bool(window.breaks)
        if missed := reader.samples_skipped - skipped_before:
            counters.samples_skipped += missed
            logger.warning(
                "%s has missed %d samples of %r from index %d on: more came at once than [pipeline] ring_s "
                "holds, or this computer was too slow",
                self._supervisor.named(_part(detector)),
                missed,
                detector.stream,
                window.first_index - window.skipped,
                extra=coded(TOO_SLOW),
            )
        if not withheld:
            return window
        breaks = sorted({*window.breaks, *([window.first_index] if broken else [])})
        return replace(window, skipped=window.skipped + withheld, breaks=tuple(breaks))

    async def _until_made(self, detector: Detector, job: Job[Sequence[Diagnosis]]) -> None:
        """Wait for a window; one that takes long must not keep its thread from the other detectors."""
        while not job.outcome.done():
            await asyncio.wait({job.outcome}, timeout=HANG_S if job.apart else LONG_S)
            if job.outcome.done() or job.given_up:
                continue
            if not job.apart:
                self._kernels.set_apart(job)
            else:
                self._kernels.give_up(job)
                hangs = f"it has computed on one window for {HANG_S:g} s"
                self._supervisor.failed(_part(detector), hangs, "the other detectors go on without it")

    def _see_names(self, detector: Detector, statements: Sequence[Diagnosis], t_ns: int) -> None:
        """See that a detector makes statements in its own name only, or in those of its `silent`.

        Raises:
            BrokenContractError: it speaks under another name, which an alarm of another detector may follow.
        """
        if all(one.detector == detector.name for one in statements):
            return
        if detector.name not in self._names:
            names = (one.detector for one in silence_statements(detector, 0.0, t_ns))
            self._names[detector.name] = frozenset({detector.name, *names})
        known = self._names[detector.name]
        for one in statements:
            if one.detector not in known:
                words = (
                    f"it returns a statement of {one.detector!r:.60}; name it {' or '.join(sorted(known))}"
                )
                raise BrokenContractError(detector.process, words)

    def _process(self, detector: Detector, window: Window) -> Sequence[Diagnosis]:
        """What a detector states about a window; on a kernel thread.

        One that raises has judged nothing: its last statement is held, and nothing is stated of its sensors.
        """
        counters = self.counters[detector.name]
        # The kernels' load on the host is a matter of the host's clock, whatever clock the samples have.
        begun_ns = time.perf_counter_ns()
        try:
            statements = window_statements(detector, window)
            self._see_names(detector, statements, window.t_end_ns)
        except Exception as error:  # noqa: BLE001 - reported and counted
            counters.failures += 1
            self._supervisor.failed(_part(detector), error, "it goes on with the next window")
            reason = f"detector {detector.name} has failed: {error_text(error)}"
            with self._supervisor.sparing_others(_part(detector), "there is no statement on that window"):
                return [
                    # It blames itself, also if it makes statements for each of its sensors: they have done
                    # nothing.
                    replace(held, quality="missing", reason=reason, sensors=())
                    for held in silence_statements(detector, 0.0, window.t_end_ns)
                ]
            return []
        else:
            return statements
        finally:
            counters.windows += 1
            counters.samples += len(window.samples)
            counters.busy_ns += time.perf_counter_ns() - begun_ns
            with self._supervisor.sparing_others("recorder", "it lacks what a detector remembers"):
                self._on_processed(detector, window)


def kernel_failed(supervisor: Supervisor) -> Callable[[BaseException], None]:
    """What counts and states that a thread of `KernelThreads` was interrupted."""
    return lambda error: supervisor.failed("kernel thread", error, "it goes on")


def _part(detector: Detector) -> str:
    return f"detector {detector.name}"


def _is_closed(ring: SampleRing) -> bool:
    return ring.is_closed
