"""The shaft's speed from its harmonics near a stated one, and whether they confirm it.

Harmonics are looked for in the signal itself, and in the envelope of its band. Each has a voice of `CAP_NATS`
at most, so that no strong line decides alone. A speed that is true gathers more voices than any other,
whichever lines the other happens to meet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.dsp.envelope import EXP_MEDIAN, hann, running_median
from daqsvc.dsp.speed.lines import OtherSpeedError, find_speed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.speed.lines import LineSpeed

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]

HARMONICS: Real = np.arange(1.0, 9.0)
WEIGHTS = np.where(HARMONICS < 4, 1.0, 0.5)
CAP_NATS = 4.0
"""Most that one harmonic counts: a strong line that is not the shaft's must not decide alone."""
ENVELOPE_WEIGHT = 0.5
"""What the envelope's lines count against the signal's: those of the bearing are there, too."""
MAINS_HZ = (50.0, 60.0)
MAINS_BINS = 2.0
"""How far the skirt of a line of the mains reaches."""
HIGHEST_ORDER = 18.0
"""Highest multiple of the stated rate that is examined: eight harmonics of the fastest speed compared with
it."""
MEDIAN_ORDERS = 2.0
"""Width of the local noise level, in multiples of the stated rate."""
LEAST_POWER = 1e-300
LEAST_RATIO = 1e-12


@dataclass(frozen=True, slots=True)
class Voices:
    """Voices for a line at every frequency of a spectrum.

    Attributes:
        nats: log of the power over its local median, capped, ``[bins]``.
        per_hz: bins per Hz.
    """

    nats: Real
    per_hz: float

    @classmethod
    def of(cls, power: Real, per_hz: float, stated_hz: float) -> Voices:
        """The voices of a power spectrum.

        Args:
            power: ``[bins]``.
            per_hz: bins per Hz.
            stated_hz: stated revolutions per second.
        """
        median = running_median(power, round(MEDIAN_ORDERS * stated_hz * per_hz))
        nats = np.log(np.maximum(power / np.maximum(median, LEAST_POWER), LEAST_RATIO))
        return cls(np.minimum(nats, CAP_NATS), per_hz)

    def at(self, hz: Real) -> Real:
        """Voices at some frequencies; 0 beyond the spectrum."""
        bins = np.rint(hz * self.per_hz).astype(np.int64)
        return np.where(bins < len(self.nats), self.nats[np.minimum(bins, len(self.nats) - 1)], 0.0)


@dataclass(frozen=True, slots=True)
class ShaftHarmonics:
    """Voices of the signal and of its envelope.

    Attributes:
        signal: the low lines of the signal.
        envelope: the lines of the whitened band's envelope: where the shaft modulates it.
    """

    signal: Voices
    envelope: Voices

    def votes(self, rates_hz: Real) -> Real:
        """Votes for some rates of revolution in nats, ``[n]``."""
        return np.asarray(self.voices(rates_hz, HARMONICS) @ WEIGHTS)

    def voices(self, rates_hz: Real, orders: Real) -> Real:
        """Voices at some orders of some rates of revolution, ``[rates, orders]``."""
        hz = np.outer(rates_hz, orders)
        return np.asarray(self.signal.at(hz) + ENVELOPE_WEIGHT * self.envelope.at(hz))

    def mains_votes(self, rate_hz: float) -> float:
        """The part of a rate's votes that lines of the mains may have cast."""
        hz: Real = rate_hz * HARMONICS
        reach = MAINS_BINS / self.signal.per_hz
        near = np.zeros(len(hz), dtype=np.bool_)
        for line_hz in MAINS_HZ:
            near |= np.abs(hz - line_hz * np.maximum(np.rint(hz / line_hz), 1.0)) <= reach
        return float((near * WEIGHTS) @ np.maximum(self.signal.at(hz), 0.0))

    def grid(self, low_hz: float, high_hz: float) -> Real:
        """Rates between two, half a bin apart at the highest harmonic."""
        return np.arange(low_hz, high_hz, 0.5 / self.signal.per_hz / float(HARMONICS[-1]))


def shaft_harmonics(
    series: Real, series_rate_hz: float, envelope_power: Real, per_hz: float, stated_hz: float
) -> ShaftHarmonics:
    """Listen for harmonics of a shaft.

    Args:
        series: ``[n]``, the signal below `HIGHEST_ORDER` times the stated rate.
        series_rate_hz: samples of it per second.
        envelope_power: power spectrum of the band's envelope, ``[bins]``.
        per_hz: bins of it per Hz.
        stated_hz: stated revolutions per second.
    """
    spectrum = scipy.fft.rfft(series * hann(len(series)))
    power = spectrum.real**2 + spectrum.imag**2
    signal = Voices.of(power, len(series) / series_rate_hz, stated_hz)
    kept = envelope_power[: int(HIGHEST_ORDER * stated_hz * per_hz) + 1]
    return ShaftHarmonics(signal, Voices.of(kept, per_hz, stated_hz))


def slow_series(spectrum: Complex, step_hz: float, stated_hz: float) -> tuple[Real, float]:
    """The low part of a signal as a slower series, which costs no time, and its samples per second.

    Args:
        spectrum: one-sided spectrum of the signal, unwindowed.
        step_hz: between its bins.
        stated_hz: stated revolutions per second.
    """
    bins = min(int(HIGHEST_ORDER * stated_hz / step_hz), len(spectrum) - 1)
    low = spectrum[:bins].copy()
    low[0] = 0.0
    samples = scipy.fft.next_fast_len(2 * bins, real=True)
    return scipy.fft.irfft(low, samples), samples * step_hz


PRIOR_SHARE = 0.006
"""Spread of the true speed about the stated one. A weaker prior was drawn to the lines of the bearing."""
LINE_REVOLUTIONS = 160.0
"""As many are enough to see 1X to 3X sharply; more cost more than they give."""
LINE_DEVIATION_SHARE = 0.002
"""Largest deviation of a speed from the lines of 1X to 3X that is taken before the votes of all harmonics."""
SEEN_NATS = 7.0
"""Votes from which harmonics stand out."""
NOT_MAINS_NATS = 3.5
"""Votes of them that must not be at multiples of the mains' frequency: about one clear harmonic."""
SAME = 0.004
"""Speeds as near as this are one, as sharply as lines show."""
NEAR = 0.03
"""A speed as near to the stated one as this may be the same, misstated."""
NEAR_NATS = 6.0
"""Lead in votes that it takes to go beyond the tolerance of the stated speed."""
SCAN = (0.48, 2.1)
"""Shares of the stated speed between which other speeds are compared with it."""
LEAD_NATS = 4.0
"""Lead in votes that another speed may have by chance, or by lines of the bearing."""
OTHER_NATS = 10.0
"""Lead in votes of another speed from which on the stated one is in doubt: three harmonics or more that stand
out clearly there and not here."""
OTHER_LEAST_NATS = 13.0
"""Votes that it must have besides: the most of any speed in 600 records of noise were 10."""
WHOLE_SHARE = 0.4
"""Voices of half orders over those of whole ones from which on they look like harmonics themselves; the same
of odd orders over even ones, below which they look like none."""
CAGE_SLIP = 0.02
KNOWN = 0.01
"""How far the skirts of another machine's harmonics vote for its speed, as a share."""
REMEDY = "give the speed of this recording and the rate it was sampled with"


@dataclass(frozen=True, slots=True)
class ShaftRate:
    """The shaft's rate of revolution.

    Attributes:
        rate_hz: revolutions per second.
        seen: whether harmonics of the shaft stand out at that rate, and more so than at any other.
        sharp: whether it is known to a fraction of the search.
        doubt: why they do not confirm it; empty if they do.
        rival_hz: the rate that they indicate instead; None if they do not.
        scan: votes for all speeds about the stated one.
        beside_hz: the rate nearby that more harmonics indicate, although the stated one has its own; None if
            there is none.
    """

    rate_hz: float
    seen: bool
    sharp: bool = False
    doubt: str = ""
    rival_hz: float | None = None
    scan: SpeedScan | None = None
    beside_hz: float | None = None

    def explained(self, hz: float) -> ShaftRate:
        """The same where the harmonics of another rate are known to be something else's.

        Args:
            hz: rate of the other; its half and its double are it, too.
        """
        if self.rival_hz is None or self.scan is None:
            return self
        if not any(abs(self.rival_hz / (factor * hz) - 1.0) <= SAME for factor in (0.5, 1.0, 2.0)):
            return self
        doubt = self.scan.unseen(self.rate_hz)
        return replace(self, seen=not doubt, doubt=doubt, rival_hz=None)

    def outvoted(self, rival_hz: float, slip: float) -> bool:
        """Whether harmonics stand out at another rate, and more so than at this one.

        Args:
            rival_hz: the other rate.
            slip: how far it may be from there, as a share.
        """
        if self.scan is None:
            return False
        rival = self.scan.votes_about(rival_hz, slip)
        return rival >= SEEN_NATS and rival > self.scan.votes_about(self.rate_hz, SAME)


def shaft_rate(
    series: Real,
    series_hz: float,
    envelope_power: Real,
    per_hz: float,
    stated_hz: float,
    tolerance: float,
    cage: float,
) -> ShaftRate:
    """Refine a stated shaft rate by the harmonics of the shaft in a signal and in its envelope.

    The lines of 1X to 3X decide where they stand out (`find_speed`); otherwise eight harmonics vote, each
    with a limited voice. A louder machine may turn nearly as fast: where several shafts show lines about the
    stated speed, the nearest is used. The votes also show whether the speed is confirmed: it
    must have more of them than any other from half to twice the stated one.

    Args:
        series: ``[n]``, the low part of the signal, by `slow_series`.
        series_hz: its samples per second.
        envelope_power: power spectrum of the band's envelope.
        per_hz: bins of it per Hz.
        stated_hz: stated revolutions per second.
        tolerance: how far to search, as a share.
        cage: order of the bearing's cage.
    """
    harmonics = shaft_harmonics(series, series_hz, envelope_power, per_hz, stated_hz)
    scan = SpeedScan.of(harmonics, stated_hz, cage)
    wrong_hz: float | None = None
    enough = series[: int(LINE_REVOLUTIONS * series_hz / stated_hz)]
    line: LineSpeed | None = None
    try:
        line = find_speed(enough[:, np.newaxis], series_hz, stated_hz)
    except OtherSpeedError as error:
        wrong_hz = error.harmonics_hz
    rate_hz, sharp = scan.voted(tolerance), False
    if line is not None and line.seen and line.deviation_hz <= LINE_DEVIATION_SHARE * stated_hz:
        within = abs(line.hz / stated_hz - 1.0) <= tolerance
        sharp = within or scan.votes_about(line.hz) > scan.votes_about(rate_hz) - LEAD_NATS
        rate_hz = line.hz if sharp else rate_hz
    beside = scan.best(np.abs(scan.share - 1.0) <= NEAR)
    if scan.votes_about(beside) > scan.votes_about(rate_hz) + NEAR_NATS:
        rate_hz, sharp = beside, True
    beside_hz: float | None = None
    own_hz = _own_lines(series, series_hz, stated_hz, rate_hz)
    if own_hz is not None:
        rate_hz, sharp, beside_hz = own_hz, True, rate_hz
        scan = scan.apart_from(beside_hz)
    doubt, rival_hz = scan.doubt(rate_hz)
    far_hz = scan.far_ahead(rate_hz)
    # A damaged ball makes lines at 1X less the cage's rate that can outweigh the shaft's own.
    if wrong_hz is not None and doubt and not _cage_line(enough, series_hz, (1.0 - cage) * stated_hz):
        far_hz = wrong_hz
    if far_hz is not None:
        rival_hz = far_hz
        doubt = (
            f"far more harmonics of a shaft stand out at about {60.0 * far_hz:.0f} rpm than at "
            f"{60.0 * stated_hz:g} rpm: those of a machine nearby, unless the speed or the sample rate is "
            f"wrong; {REMEDY}"
        )
    return ShaftRate(rate_hz, not doubt, sharp, doubt, rival_hz, scan, beside_hz)


@dataclass(frozen=True, slots=True)
class SpeedScan:
    """Votes for all speeds about a stated one.

    Attributes:
        harmonics: what votes.
        stated_hz: stated revolutions per second.
        rates_hz: speeds, ``[n]``.
        votes: for them in nats, ``[n]``.
        share: the speeds over the stated one, ``[n]``.
        others: which of them would be another speed, ``[n]``.
    """

    harmonics: ShaftHarmonics
    stated_hz: float
    rates_hz: Real
    votes: Real
    share: Real
    others: NDArray[np.bool_]

    @classmethod
    def of(cls, harmonics: ShaftHarmonics, stated_hz: float, cage: float) -> SpeedScan:
        """Count the votes for all speeds about a stated one."""
        rates = harmonics.grid(SCAN[0] * stated_hz, SCAN[1] * stated_hz)
        share = rates / stated_hz
        others = np.abs(share - 1.0) > NEAR
        # The shaft's own multiples are recognised by the half and the odd orders instead.
        # A damaged ball strikes both races as the cage carries it past: at multiples of 1X less the cage.
        for own in (0.5, 2.0, *((1.0 - cage) * k for k in (1, 2, 3))):
            others &= np.abs(share / own - 1.0) > CAGE_SLIP
        return cls(harmonics, stated_hz, rates, harmonics.votes(rates), share, others)

    def apart_from(self, known_hz: float) -> SpeedScan:
        """The same without another machine's rate, its half and its double among the other speeds."""
        own = [np.abs(self.rates_hz / (factor * known_hz) - 1.0) <= KNOWN for factor in (0.5, 1.0, 2.0)]
        return replace(self, others=self.others & ~np.logical_or.reduce(own))

    def voted(self, tolerance: float) -> float:
        """The rate about the stated one that most harmonics indicate."""
        inside = np.flatnonzero(np.abs(self.share - 1.0) <= tolerance)
        total = self.votes[inside] - 2.0 * ((self.share[inside] - 1.0) / PRIOR_SHARE) ** 2
        return float(self.rates_hz[inside[np.argmax(total)]])

    def best(self, among: NDArray[np.bool_]) -> float:
        """The rate of some that most harmonics indicate."""
        return float(self.rates_hz[np.argmax(np.where(among, self.votes, -np.inf))])

    def votes_about(self, rate_hz: float, reach: float = SAME) -> float:
        """Most votes for a rate within a share of one; minus infinity beyond the scan."""
        about = np.abs(self.rates_hz / rate_hz - 1.0) <= reach
        return float(self.votes[about].max(initial=-np.inf))

    def unseen(self, rate_hz: float) -> str:
        """Why no harmonics of a rate are taken to stand out, whatever others do; empty if they are."""
        own = self.votes_about(rate_hz)
        if own < SEEN_NATS:
            return "no harmonics of the shaft stand out"
        if own - self.harmonics.mains_votes(rate_hz) < NOT_MAINS_NATS:
            return "only harmonics at multiples of the mains' frequency stand out"
        return ""

    def doubt(self, rate_hz: float) -> tuple[str, float | None]:
        """Why the harmonics do not confirm a rate, empty if they do, and which one they indicate instead."""
        if unseen := self.unseen(rate_hz):
            return unseen, None
        own = self.votes_about(rate_hz)
        other = self.best(self.others)
        if self.votes_about(other) > own + LEAD_NATS:
            return f"more harmonics stand out at {60.0 * other:.0f} rpm", other
        odd, even, half = (
            float(self.harmonics.voices(np.array([rate_hz]), orders).mean())
            for orders in (np.arange(1.0, 9.0, 2.0), np.arange(2.0, 9.0, 2.0), np.arange(0.5, 8.0))
        )
        if half > WHOLE_SHARE * max(odd, even):
            return (
                f"half orders stand out as well, as if the shaft turned at {30.0 * rate_hz:.0f} rpm",
                0.5 * rate_hz,
            )
        if odd < WHOLE_SHARE * even:
            return (
                f"only even harmonics stand out, as if the shaft turned at {120.0 * rate_hz:.0f} rpm",
                2.0 * rate_hz,
            )
        return "", None

    def far_ahead(self, rate_hz: float) -> float | None:
        """Another rate with far more votes; None if there is none."""
        other = self.best(self.others)
        votes = self.votes_about(other)
        far = votes >= OTHER_LEAST_NATS and votes - self.votes_about(rate_hz) > OTHER_NATS
        return other if far else None


_OWN_ORDERS = (1, 2, 3)
_OWN_LEAST = 2
"""Lines of 1X to 3X that a shaft must have by itself beside a louder one."""
_OWN_PADDING = 4
_OWN_NATS = 14.0
"""Evidence for a line that is no chance at any of some hundred places."""
_OWN_POWER = 0.01
"""Of the strongest line about an order: what leaks from there is less than a tenth of this."""
_OWN_VALLEY = 0.1
"""What is left between two lines that are two, over the lesser of them; a smeared line has no valley."""


def _own_lines(series: Real, series_hz: float, stated_hz: float, taken_hz: float) -> float | None:
    """The rate nearer to the stated one than another that has lines of its own; None if there is none.

    Args:
        series: ``[n]``, the low part of the signal.
        series_hz: its samples per second.
        stated_hz: stated revolutions per second.
        taken_hz: the rate that most harmonics indicate.
    """
    if abs(taken_hz / stated_hz - 1.0) <= SAME:
        return None
    lines = _LowLines.of(series, series_hz)
    found = [hz for hz in lines.peaks(stated_hz) if abs(hz / taken_hz - 1.0) > SAME]
    for hz in sorted(found, key=lambda hz: abs(hz - stated_hz)):
        if abs(hz - stated_hz) >= abs(taken_hz - stated_hz):
            break
        own = {order: at for order in _OWN_ORDERS if (at := lines.beside(order, hz, taken_hz)) is not None}
        if len(own) >= _OWN_LEAST:
            highest = max(own)
            return own[highest] / highest
    return None


@dataclass(frozen=True, slots=True)
class _LowLines:
    """A finely sampled spectrum of the lowest orders.

    Attributes:
        power: ``[bins]``.
        per_hz: bins per Hz.
    """

    power: Real
    per_hz: float

    @classmethod
    def of(cls, series: Real, series_hz: float) -> _LowLines:
        """The spectrum of a series."""
        points = _OWN_PADDING * len(series)
        spectrum = scipy.fft.rfft(series * hann(len(series)), points)
        return cls(spectrum.real**2 + spectrum.imag**2, points / series_hz)

    def peaks(self, stated_hz: float) -> list[float]:
        """Where lines may be within `NEAR` of a rate, in Hz."""
        first, last = (round((1.0 + side * NEAR) * stated_hz * self.per_hz) for side in (-1.0, 1.0))
        about = self.power[first - 1 : last + 2]
        top = np.flatnonzero((about[1:-1] > about[:-2]) & (about[1:-1] >= about[2:])) + first
        return [float(self._vertex(int(at))) for at in top]

    def beside(self, order: int, rate_hz: float, other_hz: float) -> float | None:
        """The line at an order of a rate in Hz, if it is one by itself beside that of another rate."""
        first, last = (round(order * (1.0 + side * NEAR) * rate_hz * self.per_hz) for side in (-1.0, 1.0))
        if last + 2 >= len(self.power):
            return None
        around = self.power[first : last + 1]
        reach = _OWN_PADDING
        own, other = (self._highest(order * hz * self.per_hz, reach) for hz in (rate_hz, other_hz))
        power = self.power[own]
        if abs(own - other) < reach or not self.power[own - 1] <= power >= self.power[own + 1]:
            return None
        valley = float(self.power[min(own, other) : max(own, other) + 1].min())
        noise = float(np.median(around)) / EXP_MEDIAN
        least = max(_OWN_NATS * noise, _OWN_POWER * float(around.max()))
        if power < least or valley > _OWN_VALLEY * min(power, self.power[other]):
            return None
        return self._vertex(own)

    def _highest(self, place: float, reach: int) -> int:
        """The strongest bin about a place."""
        first = round(place) - reach
        return first + int(np.argmax(self.power[first : first + 2 * reach + 1]))

    def _vertex(self, at: int) -> float:
        """Where a peak is between the bins, in Hz."""
        low, middle, high = np.sqrt(self.power[at - 1 : at + 2])
        bend = low - 2.0 * middle + high
        shift = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
        return float((at + shift) / self.per_hz)


def _cage_line(series: Real, rate_hz: float, line_hz: float) -> bool:
    """Whether the line at 1X less the cage's rate stands out, as its own speed."""
    try:
        line = find_speed(series[:, np.newaxis], rate_hz, line_hz)
    except OtherSpeedError:
        return False
    return line.seen and abs(line.hz / line_hz - 1.0) < CAGE_SLIP
