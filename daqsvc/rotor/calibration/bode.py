"""A rotor from the Bode plot of one probe: 1X vectors against speed.

Each mode of natural frequency omega_i and damping ratio zeta_i contributes its response to unbalance, times
a complex gain (eccentricity by modal participation). A constant vector is what does not follow the speed, the
shaft's runout and the response of modes far above:

    Z(Omega) = r + sum over i of g_i w_i^2 / (1 - w_i^2 + 2 i zeta_i w_i),   w_i = Omega / omega_i

That is the response at steady speeds. A run-up that passes a lightly damped critical speed rings after it. If
the vectors are those of a sweep with a known acceleration, each mode's response is computed along the sweep
instead (`daqsvc.rotor.calibration.run_up`), ringing and late peak included.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.calibration.run_up import forcing_of, whirl_by_unbalance
from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.baseline import NotCalibratableError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]
    Response = Callable[[float, float], Complexes]

LEAST_VECTORS = 12

_MOST_MODES = 2
_STARTS = 12
"""Speeds at which a mode may be looked for first."""
_FIRST_DAMPING = 0.03
_SAMPLES_PER_REVOLUTION = 32.0
_RUN_IN = 0.6
"""Speed at which a sweep is assumed to begin, as a part of the lowest: its start has died out by there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BodeFit:
    """Modes fitted to a Bode plot.

    Attributes:
        critical_speeds_rpm: natural frequencies as speeds, the lowest first.
        damping_ratios: of the same modes.
        gains: complex gain of each, in the unit of the vectors.
        runout: complex vector that does not follow the speed.
        fitted: complex128 ``[n]``, the vectors of the model.
        vector_error: rms of what is left over that of the vectors.
        amplitude_error: rms of the relative error of the amplitude.
        phase_error_deg: rms error of the phase.
    """

    critical_speeds_rpm: tuple[float, ...]
    damping_ratios: tuple[float, ...]
    gains: tuple[complex, ...]
    runout: complex
    fitted: Complexes
    vector_error: float
    amplitude_error: float
    phase_error_deg: float

    def at(self, speed_rpm: Floats | float) -> Complexes:
        """The vector at a steady speed, or at several."""
        speed = np.asarray(speed_rpm, dtype=np.float64)
        total = np.full(speed.shape, self.runout, dtype=np.complex128)
        for critical, damping, gain in zip(
            self.critical_speeds_rpm, self.damping_ratios, self.gains, strict=True
        ):
            total = total + gain * unbalance_response(speed / critical, damping)
        return np.asarray(total)


def fit_bode(
    speed_rpm: Floats, vectors: Complexes, *, modes: int | None = None, sweep_rpm_per_s: float | None = None
) -> BodeFit:
    """Fit one mode, or two where the critical speed is split.

    Args:
        speed_rpm: float64 ``[n]``, growing.
        vectors: complex128 ``[n]``, 1X vectors in any unit, the phase of a lag negative.
        modes: how many; the number that explains the vectors best for its parameters (Schwarz 1978) if None.
        sweep_rpm_per_s: acceleration of the run-up; None if the vectors are those of steady speeds.

    Raises:
        NotCalibratableError: too few vectors, or speeds that do not grow.
    """
    if speed_rpm.shape != vectors.shape or len(vectors) < LEAST_VECTORS:
        raise NotCalibratableError(
            f"a Bode plot of {len(vectors)} vectors at {len(speed_rpm)} speeds cannot be fitted; give at "
            f"least {LEAST_VECTORS}, one for each speed"
        )
    if not (np.all(np.diff(speed_rpm) > 0.0) and speed_rpm[0] > 0.0 and np.isfinite(vectors).all()):
        raise NotCalibratableError(
            "the speeds of a Bode plot must be above 0 and grow, and its vectors be finite; sort them and "
            "leave out what is missing"
        )
    response = _steady(speed_rpm) if sweep_rpm_per_s is None else _swept(speed_rpm, sweep_rpm_per_s)
    fits = [
        _fit(speed_rpm, vectors, response, count)
        for count in ((modes,) if modes else range(1, _MOST_MODES + 1))
    ]

    def criterion(fit: BodeFit) -> float:
        figures = 4 * len(fit.gains) + 2
        n = 2 * len(vectors)
        return n * math.log(max(fit.vector_error, 1e-12) ** 2) + figures * math.log(n)

    return min(fits, key=criterion)


def _steady(speed_rpm: Floats) -> Response:
    """1X of a mode at steady speeds, by natural frequency in rad/s and damping ratio."""

    def response(omega: float, zeta: float) -> Complexes:
        return unbalance_response(speed_rpm * math.pi / 30.0 / omega, zeta)

    return response


def _swept(speed_rpm: Floats, sweep_rpm_per_s: float) -> Response:
    """1X of a mode along an even sweep, over the revolution about each of the speeds."""
    if not sweep_rpm_per_s > 0.0:
        raise NotCalibratableError(f"a sweep of {sweep_rpm_per_s} rpm/s is none; give a rate above 0")
    begin, end = _RUN_IN * speed_rpm[0] / 60.0, speed_rpm[-1] / 60.0
    rate = sweep_rpm_per_s / 60.0
    step_s = 1.0 / (_SAMPLES_PER_REVOLUTION * end)
    time_s = np.arange(0.0, (end - begin) / rate + 2.0 / end, step_s)
    turns = begin * time_s + rate * time_s**2 / 2.0
    at_s = (speed_rpm / 60.0 - begin) / rate
    middle = begin * at_s + rate * at_s**2 / 2.0
    first, last = (np.searchsorted(turns, middle + half) for half in (-0.5, 0.5))
    angle = math.tau * turns
    forcing, back = forcing_of(angle), np.exp(-1j * angle)

    def response(omega: float, zeta: float) -> Complexes:
        turned = whirl_by_unbalance(forcing, angle, step_s, omega, zeta) * back
        total = np.concatenate(([0.0], np.cumsum(turned)))
        return np.asarray((total[last] - total[first]) / (last - first))

    return response


def _fit(speed_rpm: Floats, vectors: Complexes, response: Response, count: int) -> BodeFit:
    def columns(logs: Floats) -> Complexes:
        modes = [response(*np.exp(logs[2 * i : 2 * i + 2])) for i in range(count)]
        return np.column_stack((*modes, np.ones(len(vectors))))

    def residual(logs: Floats) -> Floats:
        table = columns(logs)
        left = vectors - table @ np.linalg.lstsq(table, vectors, rcond=None)[0]
        return np.asarray(left, dtype=np.complex128).view(np.float64)

    lowest, highest = (math.log(speed_rpm[i] * math.pi / 30.0) for i in (0, -1))
    places = np.linspace(lowest, highest, _STARTS + 2)[1:-1]
    starts = [
        np.array([value for place in chosen for value in (place, math.log(_FIRST_DAMPING))])
        for chosen in itertools.combinations(places, count)
    ]
    from scipy.optimize import least_squares  # noqa: PLC0415 - slow to import, and the service fits nothing

    # Only the best of the starts are worth a search.
    starts.sort(key=lambda logs: float(np.sum(residual(logs) ** 2)))
    margin = math.log(1.2)
    bounds = ([lowest - margin, math.log(1e-3)] * count, [highest + margin, math.log(0.9)] * count)
    best = min(
        (
            least_squares(residual, logs, bounds=bounds, x_scale=[0.01, 0.2] * count, max_nfev=60)
            for logs in starts[:3]
        ),
        key=lambda result: float(result.cost),
    )
    table = columns(best.x)
    linear = np.linalg.lstsq(table, vectors, rcond=None)[0]
    fitted = np.asarray(table @ linear)
    order = np.argsort(best.x[::2])
    ratio = fitted / vectors
    return BodeFit(
        critical_speeds_rpm=tuple((np.exp(best.x[::2]) * 30.0 / math.pi)[order].tolist()),
        damping_ratios=tuple(np.exp(best.x[1::2])[order].tolist()),
        gains=tuple(linear[:-1][order].tolist()),
        runout=complex(linear[-1]),
        fitted=fitted,
        vector_error=float(np.linalg.norm(vectors - fitted) / np.linalg.norm(vectors)),
        amplitude_error=float(np.sqrt(np.mean((np.abs(ratio) - 1.0) ** 2))),
        phase_error_deg=math.degrees(float(np.sqrt(np.mean(np.angle(ratio) ** 2)))),
    )
