"""When a simulated device does what it does: in real time, or as fast as its receiver can follow.

Devices that play a plan of frames over a link that may refuse them have `PlannedNode` in common.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import time
from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import TYPE_CHECKING, Protocol

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from sim_hw.link_faults import Fault

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.acquisition.clock import Clock, DrivenClock
    from sim_hw.link_faults import FaultCounts
    from sim_hw.node_faults import NodePlan
    from sim_hw.played import PlayedStream


STEP_NS = 2_000_000
HOLD_NS = 500_000
SHORTEST_SLEEP_NS = 1_000_000


class Pacer(Protocol):
    """Lets simulated time pass. Several devices may wait on the same one."""

    async def wait_until(self, t_ns: int) -> None:
        """Return once ``t_ns`` of simulated time have passed since the start."""
        ...


class RealTimePacer:
    """Simulated time is real time. Deadlines are absolute, so that lateness never adds up.

    The start is the first call of `wait_until`.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._start_ns: int | None = None

    async def wait_until(self, t_ns: int) -> None:
        """See `Pacer.wait_until`; gives way to the event loop even if ``t_ns`` has passed."""
        now_ns = self._clock.monotonic_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        await self._clock.sleep_ns(self._start_ns + t_ns - now_ns)


class DrivenPacer:
    """Drives a `DrivenClock`, at most ``speed`` times as fast as real time, and never past its receiver.

    The clock moves in steps of at most 2 ms simulated, never past the time that some device waits for, and
    it stops while the receiver's backlog is over its limit. So nothing is lost at any speed of playing.

    The start is the reading of the clock when the pacer is made.

    Args:
        clock: the clock to drive.
        backlog: how much the receiver has yet to work off, in the unit of ``limit``.
        limit: the clock stands still while ``backlog()`` is greater.
        speed: simulated over real time, at most; infinite for as fast as it goes.
        stall_s: real seconds after which a backlog that stays over its limit is an error.
        real: the real clock.

    Raises:
        ValueError: ``speed`` is not positive.
    """

    def __init__(
        self,
        clock: DrivenClock,
        backlog: Callable[[], int],
        limit: int,
        *,
        speed: float = math.inf,
        stall_s: float = 30.0,
        real: Clock | None = None,
    ) -> None:
        if not speed > 0:
            raise ValueError(f"speed is {speed}; give a positive number of times real time, or inf")
        self._clock = clock
        self._backlog = backlog
        self._limit = limit
        self._speed = speed
        self._stall_s = stall_s
        self._real: Clock = SystemClock() if real is None else real
        self._start_ns = clock.monotonic_ns()
        self._real_start_ns: int | None = None
        self._held_until_ns = -1
        self._waited_for: list[int] = []

    async def wait_until(self, t_ns: int) -> None:
        """See `Pacer.wait_until`.

        Raises:
            TimeoutError: the receiver's backlog stayed over its limit for ``stall_s``.
        """
        deadline_ns = self._start_ns + t_ns
        heapq.heappush(self._waited_for, deadline_ns)
        try:
            while self._clock.monotonic_ns() < deadline_ns:
                await asyncio.sleep(0)
                await self._hold_for_receiver()
                next_ns = min(self._clock.monotonic_ns() + STEP_NS, self._waited_for[0])
                await self._hold_for_speed(next_ns)
                # Others may have begun to wait for less, or have moved the clock already. And while
                # somebody's time has come who has not run yet, the clock waits for them.
                next_ns = min(next_ns, self._waited_for[0])
                if next_ns > self._clock.monotonic_ns():
                    self._clock.advance_to(next_ns)
        finally:
            self._waited_for.remove(deadline_ns)
            heapq.heapify(self._waited_for)

    async def _hold_for_receiver(self) -> None:
        """Let the clock stand while the receiver is behind."""
        if self._backlog() <= self._limit:
            return
        since_ns = self._real.monotonic_ns()
        while (behind := self._backlog()) > self._limit:
            held_ns = self._real.monotonic_ns() - since_ns
            if held_ns > self._stall_s * NS_PER_S:
                raise TimeoutError(
                    f"the receiver has been {behind} behind (limit {self._limit}) for {self._stall_s:g} s; "
                    "it has stopped reading"
                )
            await self._real.sleep_ns(HOLD_NS)
        self._shift_real_start(since_ns)

    async def _hold_for_speed(self, next_ns: int) -> None:
        """Let the clock stand while ``next_ns`` would be ahead of ``speed`` times real time."""
        if math.isinf(self._speed):
            return
        if self._real_start_ns is None:
            self._real_start_ns = self._real.monotonic_ns()
        due_ns = self._real_start_ns + int((next_ns - self._start_ns) / self._speed)
        ahead_ns = due_ns - self._real.monotonic_ns()
        # A sleep lasts a millisecond at least: shorter ones are saved up, or they would set the pace.
        if ahead_ns > SHORTEST_SLEEP_NS:
            await self._real.sleep_ns(ahead_ns)

    def _shift_real_start(self, held_since_ns: int) -> None:
        """Forget the time since ``held_since_ns``: being held is not caught up by playing faster.

        Several devices may have been held at once; the time counts once.
        """
        now_ns = self._real.monotonic_ns()
        if self._real_start_ns is not None:
            self._real_start_ns += now_ns - max(held_since_ns, self._held_until_ns)
        self._held_until_ns = now_ns


RETRY_S = 0.002


class LinkLostError(Exception):
    """The link is gone, and the frame that was offered to it."""


class PlannedNode(ABC):
    """Plays a plan, event by event, and counts what was done.

    Args:
        plan: of its frames.
        samples_per_frame: samples of each channel in a frame.
        give_up_s: real seconds for which the link may refuse a frame before that is an error.
    """

    def __init__(self, plan: NodePlan, samples_per_frame: int, give_up_s: float) -> None:
        self._plan = plan
        self._per_frame = samples_per_frame
        self._give_up_s = give_up_s
        # Asked for at every step of a paced run, so counted once.
        makes_frame = (plan.fault != Fault.DUPLICATED) & (plan.fault != Fault.BABBLED)
        self._frames_done = np.concatenate(([0], np.cumsum(makes_frame))).tolist()
        self._played = 0
        self._retries = 0
        self._unsent = 0

    @property
    def injected(self) -> FaultCounts:
        """Frames played so far, and the faults that were really done to them."""
        return self._plan.injected(self._played)

    @property
    def frames_sent(self) -> int:
        """Frames handed to the link so far, second copies and corrupted ones included."""
        return self.injected.sent - self._unsent

    @property
    def frames_unsent(self) -> int:
        """Frames that were lost because the link was: the bus was gone, or nobody had the port open."""
        return self._unsent

    @property
    def samples_per_frame(self) -> int:
        """Samples of each channel in a frame."""
        return self._per_frame

    @property
    def samples_sent(self) -> int:
        """Samples, per channel, that were played so far, whatever became of them."""
        frames: int = self._frames_done[self._played]
        return frames * self._per_frame

    @property
    def send_retries(self) -> int:
        """How often the link had no room for a frame and it was offered again."""
        return self._retries

    @property
    def duration_ns(self) -> int:
        """Simulated time from the first sample to the last frame."""
        return int(self._plan.t_ns[-1])

    def figures(self) -> PlayedStream:
        """What has been done so far."""
        return {
            "samples_sent": self.samples_sent,
            "frames_sent": self.frames_sent,
            "frames_unsent": self.frames_unsent,
            "send_retries": self.send_retries,
            "injected": asdict(self.injected),
        }

    async def play(self, pacer: Pacer) -> None:
        """Send everything, as the pacer lets time pass.

        Raises:
            TimeoutError: the link refused a frame for ``give_up_s``.
        """
        for event, t_ns in enumerate(self._plan.t_ns.tolist()):
            await pacer.wait_until(t_ns)
            await self._do(event)
            self._played = event + 1

    @abstractmethod
    async def _do(self, event: int) -> None:
        """What the plan has for this event."""

    async def _offer(self, take: Callable[[], str]) -> bool:
        """Offer a frame until the link takes it; False if the link is lost, and the frame with it.

        Args:
            take: states why the frame is refused for now, or nothing if it is taken; raises `LinkLostError`.

        Raises:
            TimeoutError: it was refused for ``give_up_s``.
        """
        refused_since: float | None = None
        try:
            while reason := take():
                now = time.monotonic()
                refused_since = now if refused_since is None else refused_since
                if now - refused_since > self._give_up_s:
                    raise TimeoutError(reason)
                self._retries += 1
                await asyncio.sleep(RETRY_S)
        except LinkLostError:
            return False
        return True
