"""Orbits cut into whole shaft revolutions, with the shaft angle of every sample.

What is measured once a revolution needs whole revolutions: the keyphasor says where they begin, or a known
speed, or the orbit itself. A revolution is the half-open interval between two marks of angle zero and may
last a non-integer number of samples; a sample belongs to the revolution that its time lies in.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

from daqsvc.dsp.keyphasor_edges import Edge, EdgeCounts, EdgeFinder, EdgeLine, KeyphasorEdge
from daqsvc.dsp.orbit_speed import OrbitPhase
from daqsvc.dsp.shaft import WAIT_REVOLUTIONS, Between, Revolutions, Shaft
from daqsvc.dsp.steady_edges import SharpEdges, SteadyEdges

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

__all__ = [
    "EdgeCounts",
    "FixedSpeedCutter",
    "KeyphasorCutter",
    "OrbitCutter",
    "RevolutionCutter",
    "Revolutions",
]

_SPEED_RATIO = 10.0
"""A run-up may start, or a coast-down end, at this part of the expected speed, or at this multiple."""
_SHORTEST_PERIOD = 3.0


class RevolutionCutter(Protocol):
    """Cuts a stream of samples into revolutions; the result does not depend on how it comes in blocks."""

    @property
    def counts(self) -> EdgeCounts:
        """What became of the marks since the start."""
        ...

    def process(self, xy: Floats, marker: Floats | None) -> Revolutions:
        """Take in samples; return the revolutions that they complete.

        Args:
            xy: float64 ``[n, 2]``, two probes; NaN where missing.
            marker: float64 ``[n]``, keyphasor signal, NaN where missing; None if the cutter needs none.

        Raises:
            ValueError: the shapes do not fit, or the cutter needs a marker and there is none.
        """
        ...

    def reset(self) -> None:
        """Start anew after a gap: incomplete revolutions are dropped, the counts go on."""
        ...


class FixedSpeedCutter:
    """Revolutions of a known constant speed: angle zero at the first sample.

    Args:
        period_samples: samples per revolution.

    Raises:
        ValueError: the period cannot be.
    """

    def __init__(self, period_samples: float) -> None:
        _check_period(period_samples)
        self._period = period_samples
        self.counts = EdgeCounts()
        self.reset()

    def reset(self) -> None:
        """See `RevolutionCutter.reset`."""
        self._shaft = Shaft()
        self._edge = KeyphasorEdge(0, 0.0)
        self._done = 0

    def process(self, xy: Floats, marker: Floats | None = None) -> Revolutions:
        """See `RevolutionCutter.process`; ``marker`` is not looked at."""
        _check_samples(xy, marker)
        self._shaft.append(xy)
        while (end := KeyphasorEdge.at((self._done + 1) * self._period)).index <= self._shaft.position:
            self._shaft.turn(self._edge, end, 1, bend=0.0, trusted=True)
            self._edge = end
            self._done += 1
        return self._shaft.take()


class KeyphasorCutter:
    """Revolutions between the edges of a keyphasor (`EdgeFinder`, `EdgeLine`).

    Between two edges the angle follows the mean of the parabolas through them and the edge before, and
    through them and the edge after: a constant acceleration leaves no error. Edges that lie
    anywhere between two samples are placed where an evenly turning shaft puts them (`SteadyEdges`). Hence a
    revolution comes out when the next one is complete; up to three missing pulses are bridged. Where no edge
    comes for longer, or the edges make no sense, the stretch is divided evenly into revolutions that are not
    trusted.

    Args:
        threshold: level that marks the edge, in the unit of the marker.
        hysteresis: how far the signal must return past the threshold before it can make another edge.
        edge: whether the rising or the falling edge marks angle zero.
        period_samples: expected samples per revolution.
        period_range: shortest and longest period to lock at; without it, a tenth and ten times the
            expected one, as in a run-up.

    Raises:
        ValueError: a figure cannot be.
    """

    def __init__(
        self,
        *,
        threshold: float,
        hysteresis: float,
        period_samples: float,
        edge: Edge = "rising",
        period_range: tuple[float, float] | None = None,
    ) -> None:
        _check_period(period_samples)
        if period_range is None:
            shortest = max(period_samples / _SPEED_RATIO, min(_SHORTEST_PERIOD, period_samples))
            period_range = (shortest, _SPEED_RATIO * period_samples)
        self._finder = EdgeFinder(threshold, hysteresis, edge)
        self._sharp, self._steady = SharpEdges(), SteadyEdges()
        self._line = EdgeLine(period_samples, period_range)
        self._period = period_samples
        self._patience = WAIT_REVOLUTIONS * period_range[1]
        self.reset()

    @property
    def counts(self) -> EdgeCounts:
        """What became of the pulses since the start."""
        return self._line.counts

    def reset(self) -> None:
        """See `RevolutionCutter.reset`."""
        self._finder.reset()
        self._sharp.reset()
        self._steady.reset()
        self._line.reset()
        self._number = self._line.number
        self._shaft = Shaft()
        self._marks = Between(self._shaft, self._period, self._patience)

    def process(self, xy: Floats, marker: Floats | None) -> Revolutions:
        """See `RevolutionCutter.process`."""
        if marker is None:
            raise ValueError("the keyphasor cutter needs the keyphasor's samples; without one, use another")
        _check_samples(xy, marker)
        begin = self._shaft.position
        self._shaft.append(xy)
        sharp = self._sharp.sharp(marker)
        for sample, fraction in self._finder.find(marker):
            # Whatever is overdue at this sample is settled before its edge, in blocks of any size.
            self._marks.wait(begin + sample)
            accepted = self._line.judge(begin + sample, fraction)
            if self._line.number != self._number:
                self._number = self._line.number
                self._steady.reset()
                self._marks.restart(self._line.marks, self._line.period)
            elif accepted and self._line.locked:
                mark = self._steady.place(self._line.marks[-1], sharp=bool(sharp[sample]))
                self._marks.add(mark, self._line.period)
        self._marks.wait(self._shaft.position)
        return self._shaft.take()


class OrbitCutter:
    """Revolutions of a shaft without a keyphasor, by the phase of the orbit's own 1X (`OrbitPhase`).

    Angle zero is where the 1X vector points along +x. The angle follows the vector's slow turning, so a
    change of its phase that a fault makes is seen for some 30 revolutions and then becomes the new zero.
    Revolutions come out about four revolutions late, the first 16 together.

    Args:
        period_samples: expected samples per revolution, right to 4 %.

    Raises:
        ValueError: the period cannot be.
    """

    def __init__(self, period_samples: float) -> None:
        _check_period(period_samples)
        self._period = period_samples
        self.counts = EdgeCounts()
        self.reset()

    def reset(self) -> None:
        """See `RevolutionCutter.reset`."""
        self._shaft = Shaft()
        self._phase = OrbitPhase(self._period)
        self._last: KeyphasorEdge | None = None

    def process(self, xy: Floats, marker: Floats | None = None) -> Revolutions:
        """See `RevolutionCutter.process`; ``marker`` is not looked at."""
        _check_samples(xy, marker)
        self._shaft.append(xy)
        for zero in self._phase.process(xy):
            mark = KeyphasorEdge.at(zero.sample)
            if self._last is not None:
                self._shaft.turn(self._last, mark, 1, bend=0.0, trusted=zero.trusted)
            self._last = mark
            if zero.measured:
                self.counts.accepted += 1
            else:
                self.counts.missing += 1
        return self._shaft.take()


def _check_period(period_samples: float) -> None:
    if not (math.isfinite(period_samples) and period_samples > 2.0):
        raise ValueError(
            f"revolutions of {period_samples} samples cannot be cut; more than 2 samples are needed: "
            "check the speed and the sampling rate"
        )


def _check_samples(xy: Floats, marker: Floats | None) -> None:
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"revolutions are cut from two probes [n, 2], not from an array {list(xy.shape)}")
    if marker is not None and marker.shape != xy.shape[:1]:
        raise ValueError(f"{len(xy)} samples of the probes, but {list(marker.shape)} of the keyphasor")
