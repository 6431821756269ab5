"""What the bank of a rotor with two modes can tell apart; `prediction` has the paper's rotor.

Steady evidence is computed from the orbits (`coupled.coupled_evidence`). Delays, and all modes that rub, are
simulated with fixed seeds: with coupled axes the distribution of the evidence has no simple closed form.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.kernels import njit
from daqsvc.rotor import coupled_kernels
from daqsvc.rotor.coupled import couple, coupled_evidence, couplings_at_speed, process_covariance
from daqsvc.rotor.discretise import at_speed, discretise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.model import NormalisedRotor

    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]

RUNS = 16
_QUIET_REV, _AFTER_REV, _STEADY_REV = 20.0, 80.0, 20.0
_SAMPLES_PER_REV = 64
"""As many as a bank needs: at one noise density, faster sampling brings no further evidence."""


class CoupledBank:
    """A bank of a rotor with two modes, at one noise and sampling.

    Args:
        modes: the hypotheses, healthiest first.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples.
        variance_factor: how much larger the bank takes the variance of its innovations to be.
    """

    def __init__(
        self, modes: Sequence[BankMode], *, noise: float, duration: float, variance_factor: float
    ) -> None:
        w = abs(modes[0].rotor.w)
        averaged = max(1, math.floor(math.tau / (w * duration) / _SAMPLES_PER_REV))
        self._modes = modes
        self._noise, self._duration = noise / math.sqrt(averaged), duration * averaged
        self.samples_per_rev = math.tau / (w * self._duration)
        self._observers = discretise(
            modes, noise=self._noise, duration=self._duration, variance_factor=variance_factor
        )
        self._couplings = couple(
            modes,
            self._observers,
            noise=self._noise,
            duration=self._duration,
            variance_factor=variance_factor,
        )

    def steady(self, w: float | None = None) -> Floats:
        """Evidence of the row's orbit over the column's mode, nats a revolution, float64 ``[M, M]``.

        Args:
            w: normalised speed; the bank's own if not given.
        """
        observers, couplings = self._observers, self._couplings
        if w is not None:
            observers = at_speed(observers, self._modes, w, duration=self._duration)
            couplings = couplings_at_speed(couplings, observers, self._modes, w, duration=self._duration)
        return coupled_evidence(couplings, observers, self._duration)

    def changes(self, thresholds: Floats, process_noise: float, seed: int) -> tuple[Floats, Floats]:
        """Steady evidence and delays of every change, simulated.

        Args:
            thresholds: float64 ``[M, M]``, nats that change the decision from the row's mode to the column's.
            process_noise: power spectral density q of the machine's own acceleration noise, normalised.
            seed: of the noise and the shaft angles.

        Returns:
            Float64 ``[M, M]`` each: nats a revolution of the row's mode, the truth, over the column's; and
            revolutions after a change from the column's mode until half of the runs have declared the row's.
        """
        count, w = len(self._modes), self._modes[0].rotor.w
        before, after, steady = (
            round(rev * self.samples_per_rev) for rev in (_QUIET_REV, _AFTER_REV, _STEADY_REV)
        )
        kicks = np.array(
            [
                np.linalg.cholesky(
                    process_covariance(mode.rotor, process_noise, w, self._duration) + 1e-18 * np.eye(4)
                )
                for mode in self._modes
            ]
        )
        rates, delays = np.zeros((count, count)), np.zeros((count, count))
        rng = np.random.default_rng(seed)
        for truth, rival in itertools.permutations(range(count), 2):
            which = [0, rival, truth]
            delay = []
            for _ in range(RUNS):
                angle = rng.uniform(0.0, math.tau) + w * self._duration * np.arange(before + after)
                cos, sin = np.cos(angle), np.sin(angle)
                xy = np.empty((before + after, 2))
                draws = rng.standard_normal((before + after, 4))
                pair = [rival, truth]
                _move(self._observers[pair], self._couplings[pair], kicks[pair], cos, sin, before, draws, xy)
                xy += self._noise * rng.standard_normal(xy.shape)
                llr = self._llr(which, xy, cos, sin)
                rates[truth, rival] += llr[-steady:].mean() * self.samples_per_rev / RUNS
                total = np.cumsum(llr)
                cusum = total - np.minimum(np.minimum.accumulate(total), 0.0)
                passed = np.flatnonzero(cusum[before:] >= thresholds[rival, truth])
                delay.append(passed[0] / self.samples_per_rev if len(passed) else math.inf)
            delays[truth, rival] = float(np.median(delay))
        return rates, delays

    def _llr(self, which: list[int], xy: Floats, cos: Floats, sin: Floats) -> Floats:
        """Log-likelihood ratio of the third mode over the second, sample by sample."""
        observers, couplings = self._observers[which], self._couplings[which]
        states, scores = np.zeros((3, 4)), np.empty((3, len(xy)))
        states[observers["substeps"] > 0] = np.nan
        coupled_kernels.run_free(xy, cos, sin, observers, couplings, states, scores)
        return np.asarray(scores[2] - scores[1])


@njit(cache=True, nogil=True, error_model="numpy")
def _move(
    observers: Observers,
    couplings: Observers,
    kicks: Floats,
    cos: Floats,
    sin: Floats,
    change: int,
    draws: Floats,
    xy: Floats,
) -> None:
    """The disc's motion in one mode and, from a sample on, in another; its state goes on.

    Args:
        observers: ``[2]`` of `discretise.OBSERVER`.
        couplings: ``[2]`` of `coupled.COUPLED`.
        kicks: float64 ``[2, 4, 4]``, lower root of the process noise's covariance of a sample.
        cos: float64 ``[n]``, cosine of the shaft angle.
        sin: float64 ``[n]``, its sine.
        change: sample at which the mode changes.
        draws: float64 ``[n, 4]``, normal.
        xy: float64 ``[n, 2]``, out: positions, in clearances.
    """
    state, now = (0.0, 0.0, 0.0, 0.0), 0
    for k in range(len(xy)):
        if k == change:
            bx, bu, by, bv = coupled_kernels.orbit(observers[0], couplings[0], cos[k], sin[k])
            ax, au, ay, av = coupled_kernels.orbit(observers[1], couplings[1], cos[k], sin[k])
            state = (state[0] + bx - ax, state[1] + bu - au, state[2] + by - ay, state[3] + bv - av)
            now = 1
        x, _, y, _ = coupled_kernels.orbit(observers[now], couplings[now], cos[k], sin[k])
        xy[k, 0], xy[k, 1] = x + state[0], y + state[2]
        dx, du, dy, dv = coupled_kernels.predict(observers[now], couplings[now], cos[k], sin[k], state)
        a, b, c, d = draws[k]
        m = kicks[now]
        state = (
            dx + m[0, 0] * a,
            du + m[1, 0] * a + m[1, 1] * b,
            dy + m[2, 0] * a + m[2, 1] * b + m[2, 2] * c,
            dv + m[3, 0] * a + m[3, 1] * b + m[3, 2] * c + m[3, 3] * d,
        )


@dataclass(frozen=True, slots=True)
class Evidence:
    """How a changed rotor differs from the healthy one.

    Attributes:
        nats_per_rev: by a mode of the bank made for it, in the steady state.
        moved: change of rest, forward and backward 1X, in clearances.
    """

    nats_per_rev: float
    moved: tuple[complex, complex, complex]


def evidence_of(
    healthy: BankMode,
    changed: NormalisedRotor,
    *,
    noise: float,
    duration: float,
    variance_factor: float,
) -> Evidence:
    """How clearly a changed rotor is seen.

    Args:
        healthy: the healthy mode.
        changed: the rotor with a fault.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples.
        variance_factor: how much larger the bank takes the variance of its innovations to be.
    """
    modes = (healthy, replace(healthy, name="changed", rotor=changed))
    bank = CoupledBank(modes, noise=noise, duration=duration, variance_factor=variance_factor)
    steady = bank.steady()
    rotor = healthy.rotor
    return Evidence(
        nats_per_rev=float(min(steady[0, 1], steady[1, 0])),
        moved=(
            changed.rest - rotor.rest,
            changed.orbit() - rotor.orbit(),
            changed.backward_orbit() - rotor.backward_orbit(),
        ),
    )
