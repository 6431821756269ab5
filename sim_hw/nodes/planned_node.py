"""What devices have in common that play a plan of frames over a link that may refuse them."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from sim_hw.link_faults import Fault

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim_hw.link_faults import FaultCounts
    from sim_hw.node_faults import NodePlan
    from sim_hw.nodes.pacing import Pacer

RETRY_S = 0.002


class LinkLostError(Exception):
    """The link is gone, and the frame that was offered to it."""


class PlannedNode(ABC):
    """Plays a plan, event by event, and keeps the books.

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

    def figures(self) -> dict[str, Any]:
        """What has been done so far, by name."""
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
            take: says why the frame is refused for now, or nothing if it is taken; raises `LinkLostError`.

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
