"""Orders of a shaft without a keyphasor: complex amplitudes of 1X, 2X and 3X, block by block.

The speed comes from the harmonics themselves, so that every block of a recording has the same zero of the
shaft's angle. Where that zero lies is arbitrary: between two recordings only amplitudes, the phases
between channels, and those of 2X and 3X against 1X can be compared.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import scipy.fft

from daqsvc.dsp.drive_lines import TOP_ORDER, LineLevels, drive_lines, mains_line
from daqsvc.dsp.speed.lines import ORDERS, find_speed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    Flags: TypeAlias = NDArray[np.bool_]
    from daqsvc.dsp.drive_lines import DriveLines
    from daqsvc.dsp.speed.lines import LineSpeed

    Complexes: TypeAlias = NDArray[np.complex128]

LEAST_REVOLUTIONS = 8

_BLOCKS = 12
_LEAST_BLOCKS = 6
_LEAST_SAMPLES_PER_REVOLUTION = 10.0
_LEAST_PRESENT = 0.75
_CLIPPED_SHARE = 1.0 / 64.0
_DEAD = 1e-9
"""Deviation of a channel, as a part of its largest value, below which nothing moves."""
_DEVIATIONS = 4.0
"""Of the speed, within which a line may be an order."""
_BLOCK_WIDTHS = 2.0
"""Widths of a block's lines within which another one leaks into an order."""
_MOTOR_TOP_HZ = 130.0
"""What has to be examined to find twice the mains."""


@dataclass(frozen=True, slots=True)
class OrderVectors:
    """Orders 1X to 3X of a recording at constant speed.

    Attributes:
        amplitudes: complex128 ``[blocks, 3, channels]``, peak amplitudes of `ORDERS` in the unit of the
            samples, about a zero of the shaft's angle that all blocks of the recording have in common.
        residual_rms: float64 ``[blocks, channels]``, root mean square of what is left beside the mean and the
            orders.
        speed_rpm: shaft speed by the harmonics.
        speed_uncertainty_rpm: its standard deviation.
        speed_seen: whether any order stands out of the noise; otherwise ``speed_rpm`` is a guess within the
            search and the uncertainty states it.
        nominal_rpm: the speed that was stated.
        revolutions_per_block: shaft revolutions in a block.
        drives: gears and induction motors whose lines stand out.
        mains_hz: of the mains, if they stand out; None if not.
        motor_hz: of a motor's line so near to an order that it was taken out of it; None if there is none.
    """

    amplitudes: Complexes
    residual_rms: Floats
    speed_rpm: float
    speed_uncertainty_rpm: float
    speed_seen: bool
    nominal_rpm: float
    revolutions_per_block: int
    drives: tuple[DriveLines, ...] = ()
    mains_hz: float | None = None
    motor_hz: float | None = None

    def __len__(self) -> int:
        return len(self.amplitudes)

    @property
    def revolutions(self) -> int:
        """Shaft revolutions in all blocks."""
        return len(self) * self.revolutions_per_block

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.amplitudes.shape[2])


def order_vectors(
    samples: Floats, rate_hz: float, speed_rpm: float, names: Sequence[str] | None = None
) -> OrderVectors:
    """Measure orders 1X to 3X of a machine that turns at a constant, roughly known speed.

    Block by block the mean and the orders are fitted together by least squares, so blocks need not hold
    whole samples per revolution and may lack some.

    Args:
        samples: ``[n, channels]`` or ``[n]``, all of one unit; NaN and infinite ones are missing.
        rate_hz: samples per second.
        speed_rpm: nominal shaft speed; the true one is searched within 3 % of it.
        names: what messages call the channels (default: their numbers from 0).

    Raises:
        ValueError: a channel is dead, clipped or full of gaps, the recording has fewer than 8 revolutions
            or fewer than 10 samples in each, or its harmonics are those of another speed.
    """
    values = np.asarray(samples, dtype=np.float64)
    values = values[:, np.newaxis] if values.ndim == 1 else values
    if not (np.isfinite(rate_hz) and np.isfinite(speed_rpm) and rate_hz > 0.0 and speed_rpm != 0.0):
        raise ValueError(f"a speed of {speed_rpm:g} rpm at {rate_hz:g} Hz: give numbers that are not zero")
    nominal_hz = abs(speed_rpm) / 60.0
    _check_length(len(values), rate_hz, nominal_hz)
    there = np.isfinite(values)
    values = np.where(there, values, np.nan)
    for channel in range(values.shape[1]):
        name = repr(names[channel]) if names is not None else str(channel)
        _check_channel(values[there[:, channel], channel], len(values), name)
    present: Flags = np.asarray(there.all(axis=1))
    centred = np.where(present[:, np.newaxis], values - np.nanmean(values, axis=0), 0.0)
    speed = find_speed(centred, rate_hz, nominal_hz)
    drives, mains_hz = _drives(centred, rate_hz, speed)
    motor_hz = _beside_order(drives, len(centred) / rate_hz, speed.hz)
    if motor_hz is not None:
        _take_out(motor_hz, centred, present, rate_hz, speed.hz)
    amplitudes, residual, revolutions = _blocks(centred, present, rate_hz, speed.hz)
    if len(amplitudes) < _LEAST_BLOCKS:
        raise ValueError(
            f"only {len(amplitudes)} blocks of {revolutions} revolutions have enough samples; "
            f"{_LEAST_BLOCKS} are needed: give a recording with fewer gaps"
        )
    return OrderVectors(
        amplitudes=amplitudes,
        residual_rms=residual,
        speed_rpm=60.0 * speed.hz,
        speed_uncertainty_rpm=60.0 * speed.deviation_hz,
        speed_seen=speed.seen,
        nominal_rpm=abs(speed_rpm),
        revolutions_per_block=revolutions,
        drives=drives,
        mains_hz=mains_hz,
        motor_hz=motor_hz,
    )


def _drives(centred: Floats, rate_hz: float, speed: LineSpeed) -> tuple[tuple[DriveLines, ...], float | None]:
    """Gears and motors whose lines stand out, one of each kind at most, and the frequency of the mains."""
    known = speed.deviation_hz / speed.hz * _DEVIATIONS
    found: dict[str, DriveLines] = {}
    mains_hz: float | None = None
    for channel in range(centred.shape[1]):
        spectrum = scipy.fft.rfft(centred[:, channel])
        top_hz = max(TOP_ORDER * speed.hz, ORDERS[-1] * speed.hz + _MOTOR_TOP_HZ)
        levels = LineLevels(spectrum, rate_hz / len(centred), top_hz)
        for drive in drive_lines(levels, speed.hz, known=known):
            found.setdefault(drive.kind, drive)
        mains_hz = mains_hz or mains_line(levels, speed.hz, known)
    return tuple(found.values()), mains_hz


def _beside_order(drives: Sequence[DriveLines], seconds: float, speed_hz: float) -> float | None:
    """Frequency of a motor's line that a block cannot tell from an order; None if there is none."""
    block_hz = speed_hz / max(1, int(seconds * speed_hz) // _BLOCKS)
    for drive in drives:
        away_hz = min(abs(drive.frequency_hz - order * speed_hz) for order in ORDERS)
        if drive.kind == "motor" and away_hz < _BLOCK_WIDTHS * block_hz:
            return drive.frequency_hz
    return None


def _take_out(line_hz: float, centred: Floats, present: Flags, rate_hz: float, speed_hz: float) -> None:
    """Subtract a line from all channels in place, as the whole recording has it beside the orders."""
    there = np.flatnonzero(present)
    hz = np.array([*(order * speed_hz for order in ORDERS), line_hz])
    phases = np.exp(2j * np.pi / rate_hz * np.outer(there, hz))
    basis = np.concatenate((phases.real, phases.imag), axis=1)
    fit, *_ = np.linalg.lstsq(basis, centred[there], rcond=None)
    line = [len(ORDERS), len(hz) + len(ORDERS)]
    centred[there] -= basis[:, line] @ fit[line]


def _check_length(count: int, rate_hz: float, nominal_hz: float) -> None:
    revolutions = count * nominal_hz / rate_hz
    if revolutions < LEAST_REVOLUTIONS:
        raise ValueError(
            f"the recording has {revolutions:.1f} revolutions at {60.0 * nominal_hz:g} rpm; "
            f"at least {LEAST_REVOLUTIONS} are needed: give a longer one"
        )
    if rate_hz / nominal_hz < _LEAST_SAMPLES_PER_REVOLUTION:
        raise ValueError(
            f"{rate_hz:g} Hz are {rate_hz / nominal_hz:.1f} samples per revolution at {60.0 * nominal_hz:g} "
            f"rpm; at least {_LEAST_SAMPLES_PER_REVOLUTION:g} are needed: check the rate and the speed"
        )


def _check_channel(values: Floats, count: int, name: str) -> None:
    if len(values) < _LEAST_PRESENT * count:
        raise ValueError(
            f"channel {name}: {count - len(values)} of {count} samples are missing or infinite; "
            "give a recording with fewer gaps"
        )
    low, high = values.min(), values.max()
    if values.std() <= _DEAD * max(abs(low), abs(high)):
        raise ValueError(f"channel {name} is dead: every sample is {low:g}; check the sensor and its cable")
    for extreme in (low, high):
        share = float((values == extreme).mean())
        if share >= _CLIPPED_SHARE:
            raise ValueError(
                f"channel {name} is clipped: {share:.1%} of its samples are {extreme:g}; widen the range"
            )


def _blocks(
    centred: Floats, present: Flags, rate_hz: float, speed_hz: float
) -> tuple[Complexes, Floats, int]:
    """Fit block after block: amplitudes, residuals, and the revolutions in each."""
    turn = rate_hz / speed_hz
    revolutions = max(1, int(len(centred) / turn) // _BLOCKS)
    edges = np.round(np.arange(int(len(centred) / (turn * revolutions)) + 1) * turn * revolutions)
    edges = np.minimum(edges, len(centred)).astype(np.int64)
    orders = np.array([0, *ORDERS, *(-order for order in ORDERS)])
    amplitudes, residual = [], []
    for first, end in itertools.pairwise(edges):
        there = np.flatnonzero(present[first:end]) + first
        if len(there) < _LEAST_PRESENT * (end - first):
            continue
        basis = np.exp(2j * np.pi * speed_hz / rate_hz * np.outer(there, orders))
        gram = basis.conj().T @ basis
        fit = np.linalg.solve(gram, basis.conj().T @ centred[there])
        rest = centred[there] - (basis @ fit).real
        amplitudes.append(2.0 * fit[1 : 1 + len(ORDERS)])
        residual.append(np.sqrt((rest**2).mean(axis=0)))
    channels = centred.shape[1]
    if not amplitudes:
        return np.empty((0, len(ORDERS), channels), np.complex128), np.empty((0, channels)), revolutions
    return np.stack(amplitudes), np.stack(residual), revolutions
