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
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from sim_hw.node_faults_plan import NodePlan, planned

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from sim_hw.link_faults import LinkFaults

    Times = NDArray[np.int64]

MOST_PPM = 10_000.0


@dataclass(frozen=True, slots=True)
class Window:
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


EVER = Window()


@dataclass(frozen=True, slots=True)
class Drift:
    """The node's clock runs ``ppm`` too fast (too slow if negative)."""

    window: Window
    ppm: float

    def __post_init__(self) -> None:
        if not abs(self.ppm) <= MOST_PPM:
            raise ValueError(f"a drift of {self.ppm:g} ppm; give one from {-MOST_PPM:g} to {MOST_PPM:g}")


@dataclass(frozen=True, slots=True)
class Delay:
    """Frames are late, each by ``delay_s`` and by up to ``jitter_s`` more, evenly distributed."""

    window: Window
    delay_s: float = 0.0
    jitter_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("delay", self.delay_s), ("jitter", self.jitter_s)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"a {name} of {value:g} s; it must be 0 or more")


@dataclass(frozen=True, slots=True)
class Babble:
    """Another node sends frames ``frame_id`` without data, ``rate_hz`` of them a second."""

    window: Window
    rate_hz: float
    frame_id: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.rate_hz <= 1e6:
            raise ValueError(f"a node babbles {self.rate_hz:g} frames a second; give more than 0, up to 1e6")
        if math.isinf(self.window.end_s):
            raise ValueError("a babbling node must stop some time; say when the fault ends")


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
    brown_out: Sequence[Window] = ()
    counter_reset_s: Sequence[float] = ()
    silence: Sequence[Window] = ()
    link: Sequence[tuple[Window, LinkFaults]] = ()
    delay: Sequence[Delay] = ()
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
        return planned(
            self,
            samples,
            rate_hz,
            samples_per_frame=samples_per_frame,
            length=length,
            first_index=first_index,
        )


def _refuse_overlap(what: str, windows: Iterable[Window]) -> None:
    ordered = sorted(windows, key=lambda window: window.start_s)
    for one, other in itertools.pairwise(ordered):
        if other.start_s < one.end_s:
            raise ValueError(
                f"two {what} at once, from {one.start_s:g} and from {other.start_s:g} s; end one before the "
                "other begins"
            )
