"""Faults of a node and of its link, in windows of time: planned before the first frame, counted exactly.

A plan goes through what happens to a sample on its way, in this order:

1. The node's clock drifts: its samples are taken a little early or late.
2. A brown-out takes the node away for a while: what it would have sampled is never taken, and when it is
   back it counts from 0. A counter reset does so too, without a pause.
3. While it is silent the node samples and counts, and sends nothing.
4. The link drops, doubles, reorders or corrupts frames (`sim_hw.link_faults`).
5. The link delays frames, by as much for each or by chance. Frames keep their order.
6. A babbling node fills the bus with frames of its own.

From start to restart, a node's first and last frame pass steps 3 and 4 untouched: what is missing there, no
receiver can know.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from sim_hw.link_faults import Fault, FaultCounts

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from sim_hw.link_faults import LinkFaults

    Times = NDArray[np.int64]

_Scalar = TypeVar("_Scalar", bound=np.generic)

MOST_PPM = 10_000.0


@dataclass(frozen=True, slots=True)
class FaultWindow:
    """A span of playing time, from its start up to, not including, its end.

    Attributes:
        start_s: seconds from the start of the playing.
        end_s: infinite for the rest of it.

    Raises:
        ValueError: it is empty or begins before 0.
    """

    start_s: float = 0.0
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s < self.end_s:
            raise ValueError(
                f"a fault from {self.start_s:g} to {self.end_s:g} s; it must begin at 0 or later, "
                "and end after it has begun"
            )

    def holds(self, t_ns: Times) -> NDArray[np.bool_]:
        """Which of these times lie in it."""
        held: NDArray[np.bool_] = (t_ns >= self.start_s * NS_PER_S) & (t_ns < self.end_s * NS_PER_S)
        return held


EVER = FaultWindow()


@dataclass(frozen=True, slots=True)
class Drift:
    """The node's clock runs ``ppm`` too fast (too slow if negative)."""

    window: FaultWindow
    ppm: float

    def __post_init__(self) -> None:
        if not abs(self.ppm) <= MOST_PPM:
            raise ValueError(f"a drift of {self.ppm:g} ppm; give one from {-MOST_PPM:g} to {MOST_PPM:g}")


@dataclass(frozen=True, slots=True)
class FrameDelay:
    """Frames are late, each by ``delay_s`` and by up to ``jitter_s`` more, evenly distributed."""

    window: FaultWindow
    delay_s: float = 0.0
    jitter_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("delay", self.delay_s), ("jitter", self.jitter_s)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"a {name} of {value:g} s; it must be 0 or more")


@dataclass(frozen=True, slots=True)
class Babble:
    """Another node sends frames ``frame_id`` without data, ``rate_hz`` of them a second."""

    window: FaultWindow
    rate_hz: float
    frame_id: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.rate_hz <= 1e6:
            raise ValueError(f"a node babbles {self.rate_hz:g} frames a second; give more than 0, up to 1e6")
        if math.isinf(self.window.end_s):
            raise ValueError("a babbling node must stop some time; state when the fault ends")


BABBLER = -1
"""In place of the frame's number where a frame is a babbling node's."""


class CountRestart(IntEnum):
    """Why a node's count begins again with a frame."""

    NONE = 0
    BROWN_OUT = 1
    COUNTER_RESET = 2


@dataclass(frozen=True, slots=True)
class Schedule:
    """The frames that a node makes.

    Attributes:
        sample: int64 ``[f]``, which sample of the plant is the first of each frame.
        count: int64 ``[f]``, the node's own count of it.
        mark: uint8 ``[f]``, a `CountRestart` where the count begins again, else 0.
        t_ns: int64 ``[f]``, when the last sample of each frame is taken.
    """

    sample: NDArray[np.int64]
    count: NDArray[np.int64]
    mark: NDArray[np.uint8]
    t_ns: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class NodePlan:
    """What is on the bus, event by event in the order of time.

    An event sends one frame, except that a dropped or silenced one sends nothing.

    Attributes:
        schedule: the frames that the node makes.
        t_ns: int64 ``[m]``, when.
        frame: int64 ``[m]``, which frame of the schedule; `BABBLER` for a babbling node's.
        fault: uint8 ``[m]``, the `Fault` done to it.
        flips: uint8 ``[m, length]``, bits to flip in the frame.
        late: bool ``[m]``, whether it is sent later than it was due.
        mark: uint8 ``[m]``, a `CountRestart` at the frame with which the node counts again.
        babble_id: int64 ``[m]``, id of a babbling node's frame, else -1.
    """

    schedule: Schedule
    t_ns: NDArray[np.int64]
    frame: NDArray[np.int64]
    fault: NDArray[np.uint8]
    flips: NDArray[np.uint8]
    late: NDArray[np.bool_]
    mark: NDArray[np.uint8]
    babble_id: NDArray[np.int64]

    @property
    def sends(self) -> NDArray[np.bool_]:
        """Which events put a frame on the bus: bool ``[m]``."""
        sent: NDArray[np.bool_] = (self.fault != Fault.DROPPED) & (self.fault != Fault.SILENCED)
        return sent

    def injected(self, events: int | None = None) -> FaultCounts:
        """Counts over the first ``events`` events; over the whole plan unless given."""
        part = slice(events)
        return FaultCounts.of(
            self.fault[part],
            delayed=int(self.late[part].sum()),
            brown_outs=int((self.mark[part] == CountRestart.BROWN_OUT).sum()),
            counter_resets=int((self.mark[part] == CountRestart.COUNTER_RESET).sum()),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeFaults:
    """What goes wrong with a node and its link, the same for the same seed.

    Attributes:
        drift: of the node's clock; where windows overlap, drifts add up.
        brown_out: when the node has no power.
        counter_reset_s: when its counter restarts at 0, with the next frame.
        silence: when it sends nothing.
        link: when the link does what to frames. Windows do not overlap; the first and the last frame in
            each passes untouched.
        delay: when frames are late; where windows overlap, delays add up.
        babble: when another node babbles.
        seed: of the jitter; `link` has its own.

    Raises:
        ValueError: windows of ``link`` or of ``brown_out`` overlap, or a counter is reset before 0.
    """

    drift: Sequence[Drift] = ()
    brown_out: Sequence[FaultWindow] = ()
    counter_reset_s: Sequence[float] = ()
    silence: Sequence[FaultWindow] = ()
    link: Sequence[tuple[FaultWindow, LinkFaults]] = ()
    delay: Sequence[FrameDelay] = ()
    babble: Sequence[Babble] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        _refuse_overlap("brown-outs", self.brown_out)
        _refuse_overlap("link faults", [window for window, _ in self.link])
        if wrong := [at for at in self.counter_reset_s if not 0.0 < at < math.inf]:
            raise ValueError(f"the counter is reset at {wrong[0]:g} s; that must be after the start")

    @classmethod
    def of_link(cls, link: LinkFaults) -> NodeFaults:
        """Only a link's faults, all the time."""
        return cls(link=[(EVER, link)], seed=link.seed)

    @classmethod
    def of(cls, faults: NodeFaults | LinkFaults | None) -> NodeFaults:
        """What is given, as faults of a node: those of its link alone, or none."""
        if isinstance(faults, NodeFaults):
            return faults
        return cls() if faults is None else cls.of_link(faults)

    @property
    def without_babble(self) -> NodeFaults:
        """The same, but for the babbling node: for the second and any other node on a bus."""
        return replace(self, babble=())

    def plan(
        self, samples: int, rate_hz: float, *, samples_per_frame: int, length: int, first_index: int = 0
    ) -> NodePlan:
        """Decide when the node takes its samples, what it sends, and what becomes of it.

        Args:
            samples: how many there are, a ``1 / rate_hz`` apart by the node's clock; sample 0 is taken at 0.
            rate_hz: samples per second.
            samples_per_frame: samples of each channel in a frame.
            length: bytes of a frame in which bits may be flipped.
            first_index: the node's count of sample 0.
        """
        taken_ns = _taken_ns(self.drift, samples, rate_hz)
        schedule = _schedule(self, taken_ns, samples_per_frame, first_index)
        events = _on_the_link(self, schedule, length)
        t_ns = _arrivals(self.delay, events.t_ns, np.random.default_rng([self.seed, 1]))
        mark = np.zeros(len(events.frame), np.uint8)
        first_of_frame = np.unique(events.frame, return_index=True)[1]
        mark[first_of_frame] = schedule.mark[events.frame[first_of_frame]]
        plan = NodePlan(
            schedule=schedule,
            t_ns=t_ns,
            frame=events.frame,
            fault=events.fault,
            flips=events.flips,
            late=t_ns > events.t_ns,
            mark=mark,
            babble_id=np.full(len(t_ns), -1),
        )
        return _with_babble(plan, self.babble)


def _refuse_overlap(what: str, windows: Iterable[FaultWindow]) -> None:
    ordered = sorted(windows, key=lambda window: window.start_s)
    for one, other in itertools.pairwise(ordered):
        if other.start_s < one.end_s:
            raise ValueError(
                f"two {what} at once, from {one.start_s:g} and from {other.start_s:g} s; end one before the "
                "other begins"
            )


@dataclass(frozen=True, slots=True)
class _Events:
    """Events before they are delayed."""

    frame: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    fault: NDArray[np.uint8]
    flips: NDArray[np.uint8] = field(repr=False)

    @classmethod
    def all_alike(cls, frame: NDArray[np.int64], t_ns: Times, fault: Fault, length: int) -> _Events:
        """Events that all have the same fate."""
        return cls(
            frame, t_ns, np.full(len(frame), fault, np.uint8), np.zeros((len(frame), length), np.uint8)
        )

    @classmethod
    def of_link(
        cls, link: LinkFaults, frame: NDArray[np.int64], t_ns: Times, length: int, *, salt: int
    ) -> _Events:
        """What a link does to these frames; each part of a run has draws of its own."""
        plan = link.plan(t_ns, length, salt=salt)
        return cls(frame[plan.frame], plan.t_ns, plan.fault, plan.flips)

    @classmethod
    def joined(cls, parts: Sequence[_Events], length: int) -> _Events:
        """All of them in the order of time."""
        nothing = cls.all_alike(np.empty(0, np.int64), np.empty(0, np.int64), Fault.NONE, length)
        parts = [nothing, *parts]
        t_ns = np.concatenate([part.t_ns for part in parts])
        order = np.argsort(t_ns, kind="stable")
        return cls(
            np.concatenate([part.frame for part in parts])[order],
            t_ns[order],
            np.concatenate([part.fault for part in parts])[order],
            np.concatenate([part.flips for part in parts])[order],
        )


def _taken_ns(drifts: Sequence[Drift], samples: int, rate_hz: float) -> Times:
    """When each sample is taken, by the drifting clock of the node."""
    duration_s = samples / rate_hz
    edges = {0.0, *(d.window.start_s for d in drifts), *(d.window.end_s for d in drifts)}
    real_s = [at for at in sorted(edges) if at < math.inf]
    # The last interval is long enough for any drift that is allowed.
    real_s.append(2 * max(real_s[-1], duration_s) + 1)
    shown_s = [0.0]
    for start, end in itertools.pairwise(real_s):
        ppm = sum(d.ppm for d in drifts if d.window.start_s <= start < d.window.end_s)
        shown_s.append(shown_s[-1] + (end - start) * (1.0 + 1e-6 * ppm))
    taken_s = np.interp(np.arange(samples) / rate_hz, shown_s, real_s)
    return np.rint(taken_s * NS_PER_S).astype(np.int64)


def _sessions(faults: NodeFaults, taken_ns: Times, per_frame: int) -> Iterator[tuple[int, int, CountRestart]]:
    """First sample and end of each stretch over which the node's count is one, and why it begins."""
    resets = sorted(_index(taken_ns, at) for at in faults.counter_reset_s)
    begin, mark = 0, CountRestart.NONE
    for off in [*sorted(faults.brown_out, key=lambda window: window.start_s), None]:
        end = len(taken_ns) if off is None else _index(taken_ns, off.start_s)
        for reset in resets:
            # The frame under way is finished before the counter restarts; a brown-out cuts it off.
            at = begin - (begin - reset) // per_frame * per_frame
            if begin < at < end:
                yield begin, at, mark
                begin, mark = at, CountRestart.COUNTER_RESET
        yield begin, end, mark
        if off is not None:
            begin, mark = _index(taken_ns, off.end_s), CountRestart.BROWN_OUT


def _schedule(faults: NodeFaults, taken_ns: Times, per_frame: int, first_index: int) -> Schedule:
    sample: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    count: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    mark: list[NDArray[np.uint8]] = [np.empty(0, np.uint8)]
    for begin, end, why in _sessions(faults, taken_ns, per_frame):
        frames = max(end - begin, 0) // per_frame
        since = per_frame * np.arange(frames, dtype=np.int64)
        sample.append(begin + since)
        count.append(since + (first_index if why == CountRestart.NONE else 0))
        mark.append(np.where(since == 0, why, CountRestart.NONE).astype(np.uint8))
    firsts = np.concatenate(sample)
    return Schedule(
        sample=firsts,
        count=np.concatenate(count),
        mark=np.concatenate(mark),
        t_ns=taken_ns[firsts + per_frame - 1],
    )


def _on_the_link(faults: NodeFaults, schedule: Schedule, length: int) -> _Events:
    """What is sent, and what the link does to it."""
    frames = len(schedule.t_ns)
    begins = schedule.mark != CountRestart.NONE
    begins[:1] = True
    session = np.cumsum(begins)
    at_an_end = begins | np.append(begins[1:], True)
    silent = _any_holds(faults.silence, schedule.t_ns) & ~at_an_end
    window = np.full(frames, -1)
    for k, (when, _) in enumerate(faults.link):
        window[when.holds(schedule.t_ns)] = k
    parts: list[_Events] = []
    # Frames of the same session in the same window of the link share a plan of their own.
    for begin, end in _runs(session * (len(faults.link) + 1) + window):
        inside = np.arange(begin, end)
        sent, kept = inside[~silent[begin:end]], inside[silent[begin:end]]
        parts.append(_Events.all_alike(kept, schedule.t_ns[kept], Fault.SILENCED, length))
        if window[begin] < 0:
            parts.append(_Events.all_alike(sent, schedule.t_ns[sent], Fault.NONE, length))
        else:
            link = faults.link[int(window[begin])][1]
            parts.append(_Events.of_link(link, sent, schedule.t_ns[sent], length, salt=begin))
    return _Events.joined(parts, length)


def _arrivals(delays: Sequence[FrameDelay], t_ns: Times, rng: np.random.Generator) -> Times:
    """When each frame arrives: after its delay, and not before those ahead of it."""
    wait_s = np.zeros(len(t_ns))
    for delay in delays:
        draw = rng.random(len(t_ns))
        wait_s += np.where(delay.window.holds(t_ns), delay.delay_s + delay.jitter_s * draw, 0.0)
    return np.maximum.accumulate(t_ns + np.rint(wait_s * NS_PER_S).astype(np.int64))


def _with_babble(plan: NodePlan, babbles: Sequence[Babble]) -> NodePlan:
    if not babbles:
        return plan
    when_ns = [_babble_ns(babble) for babble in babbles]
    ids = [np.full(len(at), babble.frame_id) for at, babble in zip(when_ns, babbles, strict=True)]
    frames = sum(map(len, when_ns))
    t_ns = np.concatenate([plan.t_ns, *when_ns])
    order = np.argsort(t_ns, kind="stable")

    def filled(own: NDArray[_Scalar], value: float) -> NDArray[_Scalar]:
        theirs = np.full((frames, *own.shape[1:]), value, own.dtype)
        return np.concatenate([own, theirs])[order]

    return NodePlan(
        schedule=plan.schedule,
        t_ns=t_ns[order],
        frame=filled(plan.frame, BABBLER),
        fault=filled(plan.fault, Fault.BABBLED),
        flips=filled(plan.flips, 0),
        late=filled(plan.late, 0),
        mark=filled(plan.mark, CountRestart.NONE),
        babble_id=np.concatenate([plan.babble_id, *ids])[order],
    )


def _any_holds(windows: Iterable[FaultWindow], t_ns: Times) -> NDArray[np.bool_]:
    held = np.zeros(len(t_ns), np.bool_)
    for window in windows:
        held |= window.holds(t_ns)
    return held


def _index(taken_ns: Times, at_s: float) -> int:
    """The first sample taken at ``at_s`` or later."""
    return len(taken_ns) if math.isinf(at_s) else int(np.searchsorted(taken_ns, at_s * NS_PER_S))


def _runs(group: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Begin and end of each stretch of the same number."""
    edges = np.flatnonzero(np.diff(group)) + 1
    return list(zip([0, *edges.tolist()], [*edges.tolist(), len(group)], strict=True)) if len(group) else []


def _babble_ns(babble: Babble) -> Times:
    frames = math.ceil((babble.window.end_s - babble.window.start_s) * babble.rate_hz - 1e-9)
    at_s = babble.window.start_s + np.arange(frames) / babble.rate_hz
    return np.rint(at_s * NS_PER_S).astype(np.int64)
