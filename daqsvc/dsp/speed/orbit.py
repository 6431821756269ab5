"""Speed, sense of rotation and shaft angle from the orbit's own 1X, where no keyphasor shows them.

With two probes at right angles, z = x + i y turns with the shaft. Its full spectrum has the 1X line at plus
the rotational frequency for a forward orbit and at minus it for a backward one. An ellipse has both.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.dsp.quality import RefusedError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Complexes = NDArray[np.complex128]

Direction = Literal["forward", "backward", "straight"]

_SEARCH = 0.1
"""The line is searched for within this part of the stated speed."""
_MIN_REVOLUTIONS = 4.0
_MIN_SAMPLES_PER_REVOLUTION = 5.0
_MAX_SAMPLES = 2**18
_ORDERS = (1, -1, 0, 2, -2, 3, -3)
"""Orders fitted together, so that neither DC nor a harmonic leaks into 1X; +-1 first."""
_LINE_OVER_NOISE = 25.0
"""Power of both 1X lines over the noise in one bin, below which there is no line: by chance, 1 in 10^6."""
_UNDECIDED = 0.05
"""Forward and backward amplitudes that differ by less of the larger one do not show the sense."""

AT_THE_EDGE = 0.08
"""A line so far from the stated speed, of the tenth that is searched, may be the flank of another one."""
_LEAST_TURNS = 10.0
_STRONGER = 4.0
"""Largest amplitude of another line, as a multiple of 1X, that is still a whirl or a harmonic."""

_LOCK_REVOLUTIONS = 16
_LOCK_SEARCH = 0.04
"""The expected speed may be wrong by this part of it."""
_WINDOW_REVOLUTIONS = 30
_LAG_REVOLUTIONS = 0.113 * _WINDOW_REVOLUTIONS
"""Where a least-squares parabola through the window is free of the cubic term, and best known."""
_MAX_SCATTER_REV = 0.15
"""Phases that scatter by more about the parabola (0.29 is pure chance) are not those of a shaft."""
_MAX_DRIFT = 0.1
"""A speed that has drifted further from the expected one is not followed any more."""
_MAX_UNMEASURED = 3
"""Revolutions without samples, or without phases around them, that are bridged."""


@dataclass(frozen=True, slots=True)
class SpeedEstimate:
    """Speed of a shaft by its orbit.

    Attributes:
        speed_rpm: revolutions per minute, with the sign of the stated speed; positive if none was stated.
        uncertainty_rpm: its standard deviation.
        direction: ``"forward"`` if the orbit turns with the stated speed (anticlockwise, from +x to +y,
            for a positive one or none), ``"backward"`` if against it: reversed rotation or swapped probes,
            ``"straight"`` if the orbit is too flat to show it.
    """

    speed_rpm: float
    uncertainty_rpm: float
    direction: Direction


def estimate_speed(xy: Floats, rate_hz: float, around_rpm: float | None = None) -> SpeedEstimate:
    """Speed of a shaft by the 1X of its orbit, at constant speed.

    The strongest line of the full spectrum, refined by least squares together with DC, 2X and 3X. In
    white noise it attains the Cramer-Rao bound: 1.4e-4 of the speed from 50 revolutions of 64 samples at
    0 dB, 1.4e-5 at 20 dB. Of a record beyond 2^18 samples the first 2^18 count.

    Args:
        xy: float64 ``[n, 2]``, x and y in any unit; NaN where missing.
        rate_hz: sampling rate.
        around_rpm: stated speed, negative if clockwise; the line within 10 % of it is taken. Without it,
            the strongest one of the whole spectrum from 4 cycles in the record to a fifth of the rate.

    Raises:
        ValueError: the record has fewer than 4 revolutions, or no line stands out of the noise.
    """
    z, valid = _orbit(xy[:_MAX_SAMPLES])
    n = len(z)
    lowest, highest = _MIN_REVOLUTIONS / max(n, 1), 1.0 / _MIN_SAMPLES_PER_REVOLUTION
    near = ""
    if around_rpm is not None:
        stated = abs(around_rpm) / 60.0 / rate_hz
        near = f" within {_SEARCH:.0%} of {around_rpm:g} rpm"
        if not lowest <= stated <= highest:
            raise ValueError(
                f"{n} samples at {rate_hz:g} Hz and {around_rpm:g} rpm are {n * stated:.3g} revolutions of "
                f"{1 / stated if stated else math.inf:.3g} samples; the speed of an orbit needs at least "
                f"{_MIN_REVOLUTIONS:g} revolutions of at least {_MIN_SAMPLES_PER_REVOLUTION:g} samples"
            )
        lowest, highest = (1.0 - _SEARCH) * stated, (1.0 + _SEARCH) * stated
    elif lowest >= highest or 2 * int(valid.sum()) < n:
        raise ValueError(f"{int(valid.sum())} samples are too few to find the speed of an orbit in")
    fit = _fit_line(z, valid, lowest, highest)
    if fit is None:
        raise ValueError(
            f"the orbit has no 1X line{near}: check that the shaft turns, the speed and the probes"
        )
    forward, backward = (abs(amplitude) for amplitude in fit.amplitudes)
    if around_rpm is not None and around_rpm < 0.0:
        forward, backward = backward, forward
    direction: Direction = "forward" if forward > backward else "backward"
    if abs(forward - backward) < max(_UNDECIDED * max(forward, backward), 4.0 * fit.amplitude_deviation):
        direction = "straight"
    to_rpm = 60.0 * rate_hz * math.copysign(1.0, 1.0 if around_rpm is None else around_rpm)
    return SpeedEstimate(to_rpm * fit.frequency, abs(to_rpm) * fit.deviation, direction)


def refuse_elsewhere(first: Floats, rate_hz: float, stated_rpm: float, near_rpm: float | None) -> None:
    """Refuse a stated speed where the orbit is that of another one.

    Args:
        first: float64 ``[n, 2]``, the first revolutions.
        rate_hz: sampling rate.
        stated_rpm: what was stated.
        near_rpm: the line near it; None if there is none to speak of.

    Raises:
        RefusedError: the orbit is that of another speed.
    """
    try:
        strongest_rpm = estimate_speed(first, rate_hz).speed_rpm
        # This many revolutions at the true speed: after them, the machine need not be healthy any more.
        turns = max(_LEAST_TURNS, len(first) * abs(stated_rpm) / 60.0 / rate_hz)
        healthy = first[: math.ceil(turns * 60.0 * rate_hz / strongest_rpm)]
        strongest_rpm = estimate_speed(healthy, rate_hz, strongest_rpm).speed_rpm
    except ValueError:
        return  # no line anywhere: the search near the stated speed has reported it
    if abs(strongest_rpm / abs(stated_rpm) - 1.0) <= AT_THE_EDGE:
        return
    if near_rpm is None:
        near = f"there is no 1X line near {abs(stated_rpm):.6g} rpm"
    else:
        ratio = _line_um(first, rate_hz, strongest_rpm) / _line_um(first, rate_hz, near_rpm)
        if ratio < _STRONGER:
            return
        near = f"the line at {abs(near_rpm):.1f} rpm has a {ratio:.2g}th of its amplitude"
    raise RefusedError(
        f"the orbit turns at {strongest_rpm:.1f} rpm: {near}; correct the speed, or use a keyphasor if the "
        "shaft does turn as stated"
    )


def _line_um(orbit: Floats, rate_hz: float, rpm: float) -> float:
    """Amplitude of the line of a speed, both senses together."""
    z = orbit[:, 0] + 1j * orbit[:, 1]
    there = np.isfinite(z)
    turn = np.exp(2j * math.pi * rpm / 60.0 / rate_hz * np.flatnonzero(there))
    z = z[there] - z[there].mean()
    return math.hypot(abs(np.mean(z * turn.conj())), abs(np.mean(z * turn)))


@dataclass(frozen=True, slots=True)
class _Line:
    """A 1X line.

    Attributes:
        frequency: in revolutions per sample.
        deviation: its standard deviation.
        amplitudes: of +1X and -1X, about the middle of the record.
        amplitude_deviation: standard deviation of their magnitudes' difference.
    """

    frequency: float
    deviation: float
    amplitudes: tuple[complex, complex]
    amplitude_deviation: float


def _orbit(xy: Floats) -> tuple[Complexes, NDArray[np.bool_]]:
    """The orbit as x + i y, zero where it is missing, and where it is not."""
    valid = np.isfinite(xy[:, 0]) & np.isfinite(xy[:, 1])
    z: Complexes = np.where(valid, xy[:, 0], 0.0) + 1j * np.where(valid, xy[:, 1], 0.0)
    return z, valid


def _project(columns: Complexes, values: Complexes) -> tuple[Complexes, Complexes]:
    """Least squares: coefficients of the columns ``[n, m]``, and what they leave of the values ``[n]``.

    Without BLAS, whose threads cost more than they save at these sizes.
    """
    m = columns.shape[1]
    # The ridge only matters where orders coincide, as 3X and -2X do at five samples a revolution.
    gram = np.einsum("ni,nj->ij", columns.conj(), columns) + 1e-9 * len(columns) * np.eye(m)
    coefficients = np.linalg.solve(gram, np.einsum("ni,n->i", columns.conj(), values))
    return coefficients, values - np.einsum("ni,i->n", columns, coefficients)


def _fit_line(z: Complexes, valid: NDArray[np.bool_], lowest: float, highest: float) -> _Line | None:
    """The strongest 1X between two frequencies (cycles per sample); None if nothing stands out."""
    n, count = len(z), int(valid.sum())
    if 2 * count < n:
        return None
    mean = z[valid].mean()
    frequency = _strongest(np.where(valid, z - mean, 0.0), lowest, highest)
    t = (np.arange(n) - (n - 1) / 2.0)[valid]
    measured = z[valid]
    for _ in range(20):
        columns = np.exp(2j * np.pi * frequency * np.outer(t, _ORDERS))
        amplitudes, residual = _project(columns, measured)
        slope = 2j * np.pi * t * (columns[:, 0] * amplitudes[0] - columns[:, 1] * amplitudes[1])
        _, slope = _project(columns, slope)
        leverage = float(np.sum(np.abs(slope) ** 2))
        if leverage == 0.0:
            return None
        step = float(np.sum(slope.conj() * residual).real) / leverage
        # Half the width of the line at most: beyond, the slope shows nothing.
        frequency += min(max(step, -0.5 / n), 0.5 / n)
        if abs(step) * n < 1e-9:
            break
    spread = np.zeros(n, dtype=np.complex128)
    spread[valid] = residual
    # Nothing is measured finer than float32 samples are.
    finest = float(np.finfo(np.float32).eps * np.sqrt(np.mean(np.abs(measured) ** 2)))
    noise = _noise_beside(spread, frequency) / count + finest**2
    power = abs(amplitudes[0]) ** 2 + abs(amplitudes[1]) ** 2
    if not lowest <= frequency <= highest or power * count < _LINE_OVER_NOISE * noise:
        return None
    deviation = math.sqrt(0.5 * noise / leverage)
    return _Line(
        frequency, deviation, (complex(amplitudes[0]), complex(amplitudes[1])), math.sqrt(noise / count)
    )


def _strongest(z: Complexes, lowest: float, highest: float) -> float:
    """Frequency of the most power in +f and -f together, to an eighth of a line's width."""
    size = 8 * 2 ** math.ceil(math.log2(len(z)))
    power = np.abs(np.fft.fft(z, size)) ** 2
    bins = np.arange(max(1, math.ceil(lowest * size)), max(1, math.floor(highest * size)) + 1)
    strongest: int = bins[np.argmax(power[bins] + power[-bins])].item()
    return strongest / float(size)


def _noise_beside(residual: Complexes, frequency: float) -> float:
    """Mean power of the full spectrum beside +-1X: what is uncertain there, be the noise white or not."""
    n = len(residual)
    power = np.abs(np.fft.fft(residual)) ** 2
    reach = max(3, min(16, int(frequency * n / 2.0)))
    offsets = np.concatenate((np.arange(-reach, -1), np.arange(2, reach + 1)))
    at = round(frequency * n)
    return float(np.mean(power[np.concatenate((at + offsets, -at + offsets)) % n]))


@dataclass(frozen=True, slots=True)
class AngleZero:
    """Where the 1X of an orbit points along +x.

    Attributes:
        sample: in samples since the start.
        trusted: whether the revolution that ends there is known.
        measured: whether that revolution has its own phase.
    """

    sample: float
    trusted: bool
    measured: bool


class OrbitPhase:
    """Follows the phase of an orbit's 1X over blocks of samples, in whichever sense it turns.

    The first 16 revolutions give frequency and sense (`estimate_speed`'s line fit). From then on each
    revolution gives one phase, by least squares together with DC and the opposite 1X, and a parabola through
    the last 30 phases gives the angle. It is read 3.4 revolutions before its end: there it has no lag even
    when the acceleration changes, and less than half of the variance that it has at its end. A single
    revolution of 64 samples at 0 dB has 5 degrees of noise, the parabola 1.7.

    Phases that make no sense for 16 revolutions start the search again; until then, and while searching,
    the speed is guessed and nothing is trusted.

    Args:
        period_samples: expected samples per revolution, right to 4 %.
    """

    def __init__(self, period_samples: float) -> None:
        self._nominal_period = period_samples
        self._held: Complexes = np.empty(0, dtype=np.complex128)
        self._valid = np.empty(0, dtype=np.bool_)
        self._held_index = 0
        self._zeros: list[AngleZero] = []
        self._last_zero: float | None = None
        self._search(0.0)

    def process(self, xy: Floats) -> list[AngleZero]:
        """Follow the orbit over the next samples.

        Args:
            xy: float64 ``[n, 2]``; NaN where missing.

        Returns:
            The zeros of the angle that are known now and were not before.
        """
        z, valid = _orbit(xy)
        self._held = np.concatenate((self._held, z))
        self._valid = np.concatenate((self._valid, valid))
        end = self._held_index + len(self._held)
        while True:
            wanted = self._period if self._locked else _LOCK_REVOLUTIONS * self._nominal_period
            if math.ceil(self._next + wanted) > end:
                break
            if self._locked:
                self._follow()
            else:
                self._lock()
            drop = math.ceil(self._next) - self._held_index
            self._held, self._valid = self._held[drop:], self._valid[drop:]
            self._held_index += drop
        zeros, self._zeros = self._zeros, []
        return zeros

    def _search(self, begin: float) -> None:
        self._locked = False
        self._next = begin
        self._period = self._nominal_period
        self._forward = True
        self._phases: deque[tuple[float, float]] = deque(maxlen=_WINDOW_REVOLUTIONS)
        self._unmeasured = 0
        self._scattered = 0

    def _lock(self) -> None:
        """Find frequency and sense in the first revolutions."""
        begin, span = self._next, _LOCK_REVOLUTIONS * self._nominal_period
        part = slice(math.ceil(begin) - self._held_index, math.ceil(begin + span) - self._held_index)
        nominal = 1.0 / self._nominal_period
        line = _fit_line(
            self._held[part], self._valid[part], (1 - _LOCK_SEARCH) * nominal, (1 + _LOCK_SEARCH) * nominal
        )
        if line is None:
            self._guess(begin + span)
            self._next = begin + span
            return
        forward, backward = line.amplitudes
        self._forward = abs(forward) >= abs(backward)
        self._period = 1.0 / line.frequency
        # The line's amplitudes are those about the middle of the record.
        self._origin = math.ceil(begin) + (part.stop - part.start - 1) / 2.0
        phase = float(np.angle(forward if self._forward else backward.conjugate())) / (2.0 * math.pi)
        self._parabola = np.array([phase, line.frequency, 0.0])
        while self._next + self._period <= begin + span:
            self._measure()
        self._locked = True
        self._fit()
        # A first zero too close to one before would cut a revolution short that never was.
        after = begin if self._last_zero is None else self._last_zero + 0.5 * self._period
        self._turn = math.ceil(self._turns_at(after))
        self._settle(self._turns_at(self._next) - _LAG_REVOLUTIONS - 0.5, known=False)

    def _follow(self) -> None:
        """One more revolution."""
        self._measure()
        self._fit()
        scattered = self._scatter() > _MAX_SCATTER_REV
        self._scattered = self._scattered + 1 if scattered else 0
        adrift = abs(self._period / self._nominal_period - 1.0) > _MAX_DRIFT
        if adrift or max(self._scattered, self._unmeasured) > _LOCK_REVOLUTIONS:
            self._guess(self._next)
            self._search(self._next)
            return
        self._settle(self._turns_at(self._next) - _LAG_REVOLUTIONS - 0.5, known=True)

    def _measure(self) -> None:
        """Phase of the next revolution, against where the parabola has it."""
        begin, end = self._next, self._next + self._period
        self._next = end
        sample = np.arange(math.ceil(begin), math.ceil(end))
        part = slice(int(sample[0]) - self._held_index, int(sample[-1]) + 1 - self._held_index)
        valid = self._valid[part]
        if 2 * int(valid.sum()) < len(sample):
            self._unmeasured += 1
            return
        self._unmeasured = 0
        z = self._held[part][valid] if self._forward else self._held[part][valid].conj()
        middle = 0.5 * (begin + end)
        expected = self._turns_at(middle)
        turning = np.exp(2j * np.pi * ((sample[valid] - middle) / self._period + expected))
        columns = np.stack((turning, turning.conj(), np.ones_like(turning)), axis=1)
        amplitudes, _ = _project(columns, z)
        off = float(np.angle(amplitudes[0])) / (2.0 * math.pi)
        self._phases.append((middle, expected + off))

    def _fit(self) -> None:
        """Parabola through the phases: revolutions over samples from the last of them."""
        if len(self._phases) < 3:
            return
        phases = np.array(self._phases)
        self._origin, base = float(phases[-1, 0]), round(float(phases[-1, 1]))
        # In revolutions both, which keeps the three terms of one size.
        x = (phases[:, 0] - self._origin) / self._nominal_period
        bend, rate, offset = np.polyfit(x, phases[:, 1] - base, 2)
        nominal = self._nominal_period
        self._parabola = np.array([offset + base, rate / nominal, bend / nominal**2])
        ahead = self._next - self._origin
        self._period = 1.0 / max(
            float(self._parabola[1] + 2.0 * ahead * self._parabola[2]), 0.5 / self._nominal_period
        )

    def _scatter(self) -> float:
        phases = np.array(self._phases)
        since = phases[:, 0] - self._origin
        a, b, c = self._parabola
        return float(np.sqrt(np.mean((phases[:, 1] - (a + b * since + c * since**2)) ** 2)))

    def _turns_at(self, sample: float) -> float:
        since = sample - self._origin
        a, b, c = self._parabola
        return float(a + b * since + c * since**2)

    def _sample_at(self, turns: float) -> float:
        """Where the parabola reaches an angle, at or before its end; the inverse of `_turns_at`."""
        since = (turns - self._parabola[0]) / self._parabola[1]
        for _ in range(4):
            a, b, c = self._parabola
            since -= (a + b * since + c * since**2 - turns) / (b + 2.0 * c * since)
        return float(self._origin + since)

    def _settle(self, turns: float, *, known: bool) -> None:
        """Give away the zeros up to an angle; the first of a new search ends no known revolution."""
        while self._turn <= turns:
            sample = self._sample_at(self._turn)
            # The revolution that ends here, against the middles of those that were measured.
            middle = sample - 0.5 * self._period
            away = min((abs(middle - at) for at, _ in self._phases), default=math.inf) / self._period
            trusted = known and self._scattered == 0 and away <= _MAX_UNMEASURED
            self._zero(sample, trusted=trusted, measured=away <= 0.75)
            self._turn += 1
            known = True

    def _guess(self, end: float) -> None:
        """Zeros at the last known speed, up to a sample."""
        last = self._held_index - self._period if self._last_zero is None else self._last_zero
        while last + self._period <= end:
            last += self._period
            self._zero(last, trusted=False, measured=False)

    def _zero(self, sample: float, *, trusted: bool, measured: bool) -> None:
        self._last_zero = sample
        self._zeros.append(AngleZero(sample, trusted, measured))
