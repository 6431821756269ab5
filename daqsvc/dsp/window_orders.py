"""1X and 2X of one sensor in one window, and what is left without 1X, where the shaft angle is known.

A window that holds whole revolutions tells 1X from every other order; one that does not lets them leak into
each other. So the fit takes as many whole revolutions as the window has, the latest ones. It is a least
squares fit of mean, 1X and 2X together, which lacks of samples bias no more than they bias a mean.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

LEAST_SAMPLES_PER_REVOLUTION = 8.0
"""2X has four of them then."""
_LEAST_SHARE = 0.5
"""Part of the samples of these revolutions that must be there."""
_FITTED = 5
_WORST_CONDITION = 25.0
"""Largest spread of the normal equations' eigenvalues: what is missing must not lie in one piece too long."""
_SURE_OF_PHASE = 6.0
"""A phase is given if the amplitude is so many of its standard deviations: it is then good to 10 degrees."""
SLIP = 0.03
"""A shaft whose speed is not measured is looked for within this part of the stated one."""
_PER_LINE = 4
"""Places examined in the width of a line."""
_PER_TURN = 16.0
"""Samples of a revolution that are left for the search: orders beside a multiple of it are 24 dB down."""


class WindowOrders(NamedTuple):
    """1X and 2X of a window, and the rest.

    A component is ``amplitude * exp(-i lag)`` of ``amplitude * cos(order * angle - lag)``, peak.

    Attributes:
        first: 1X, in the unit of the samples.
        second: 2X, same unit.
        deviation: standard deviation of either amplitude by what is neither, same unit.
        rest_rms: RMS about the mean of what is left without 1X, same unit.
        rest_peak_to_peak: from its lowest to its highest value, same unit.
    """

    first: complex
    second: complex
    deviation: float
    rest_rms: float
    rest_peak_to_peak: float


def phase_lag_deg(component: complex, deviation: float) -> float | None:
    """Phase lag of a component in degrees, 0 to below 360; None if it does not stand out of the rest.

    The lag is from the mark of the keyphasor to the next positive peak of the component, in degrees of the
    component's own cycle (Bently; API 670).

    Args:
        component: of `WindowOrders`.
        deviation: standard deviation of its amplitude.
    """
    if abs(component) <= _SURE_OF_PHASE * deviation or component == 0:
        return None
    lag_deg = -math.degrees(cmath.phase(component)) % 360.0
    return lag_deg if lag_deg < 360.0 else 0.0  # what is a hair below 0 becomes 360.0


def window_orders(samples: Floats, angle_rad: Floats) -> WindowOrders | None:
    """Fit 1X and 2X to the latest whole revolutions of a window.

    Args:
        samples: float64 ``[n]``, any unit; what is not finite is missing.
        angle_rad: float64 ``[n]``, shaft angle from the mark in the direction of rotation, modulo 2 pi or
            not; NaN where it is not known.

    Returns:
        None where that cannot be: no whole revolution whose angle is known, fewer than
        `LEAST_SAMPLES_PER_REVOLUTION` in one, or too many of them missing.
    """
    lost = np.flatnonzero(~np.isfinite(angle_rad))
    begin = int(lost[-1]) + 1 if len(lost) else 0
    turns = np.unwrap(angle_rad[begin:]) / math.tau
    if len(turns) < 2 * LEAST_SAMPLES_PER_REVOLUTION:
        return None
    step = float(turns[-1] - turns[0]) / (len(turns) - 1)
    whole = math.floor(step * len(turns) + 1e-6)
    if whole < 1 or step * LEAST_SAMPLES_PER_REVOLUTION > 1.0:
        return None
    values = samples[begin:]
    there = np.isfinite(values)
    # Half-open at its begin by half a sample: of a revolution of 64 samples these are 64.
    fitted = there & (turns > turns[-1] - whole + 0.5 * step)
    count = int(fitted.sum())
    if count < max(_LEAST_SHARE * whole / step, 2.0 * _FITTED):
        return None
    first, second = np.cos(math.tau * turns), np.sin(math.tau * turns)
    basis = np.stack(
        [np.ones_like(turns), first, second, first**2 - second**2, 2.0 * first * second], axis=-1
    )
    part = basis[fitted]
    normal = part.T @ part
    eigenvalues = np.linalg.eigvalsh(normal)
    if eigenvalues[-1] > _WORST_CONDITION * eigenvalues[0]:
        return None
    about = float(values[fitted].mean())
    fit = np.linalg.solve(normal, part.T @ (values[fitted] - about))
    noise = values[fitted] - about - part @ fit
    rest = values[there] - about - basis[there, 1:3] @ fit[1:3]
    return WindowOrders(
        complex(fit[1], -fit[2]),
        complex(fit[3], -fit[4]),
        math.sqrt(2.0 * float(noise @ noise) / max(count - _FITTED, 1) / count),
        float(rest.std()),
        float(np.ptp(rest)),
    )


def steady_angle(samples: Floats, turns_per_sample: float) -> Floats:
    """The angle of a shaft that turns evenly at about a stated speed, by the strongest line near to it.

    Its zero is arbitrary: only amplitudes are meaningful. The line is searched within `SLIP` of the
    stated speed, by the periodogram of a Hann taper.

    Args:
        samples: float64 ``[n]``; what is not finite is missing.
        turns_per_sample: stated speed over sampling rate.

    Returns:
        Float64 ``[n]``, in rad, not wrapped; NaN if no sample is there.
    """
    there = np.isfinite(samples)
    count = len(samples)
    if not there.any():
        return np.full(count, math.nan)
    swing = np.where(there, samples - samples[there].mean(), 0.0) * np.hanning(count)
    # The search needs no more than `_PER_TURN` of a revolution, each the sum of its neighbours.
    together = max(1, int(1.0 / (_PER_TURN * turns_per_sample)))
    swing = swing[: count - count % together].reshape(-1, together).sum(axis=1)
    places = together * np.arange(len(swing))
    reach = SLIP * turns_per_sample
    each_side = math.ceil(_PER_LINE * reach * count)
    step = reach / each_side
    # With one more at either end, so that a line at the end of the search has its vertex.
    near = turns_per_sample + step * np.arange(-each_side - 1, each_side + 2)
    # A few places, one after the other: together they would need a table of all samples by all places.
    power = np.array([abs(swing @ np.exp(-1j * math.tau * one * places)) ** 2 for one in near])
    best = 1 + int(power[1:-1].argmax())
    before, at, after = (float(one) for one in power[best - 1 : best + 2])
    bend = before - 2.0 * at + after
    off = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    speed = float(near[best]) + step * min(max(off, -0.5), 0.5)
    return np.asarray(math.tau * speed * np.arange(count), dtype=np.float64)
